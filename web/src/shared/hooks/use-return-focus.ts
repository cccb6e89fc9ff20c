import { useEffect, useRef } from "preact/hooks";
import type { RefObject } from "preact";

/** Returns the focus to the button that opened an inline panel after the panel closes. */
export function useReturnFocus(open: boolean): RefObject<HTMLButtonElement | null> {
  const button = useRef<HTMLButtonElement>(null);
  const was = useRef(open);
  useEffect(() => {
    if (was.current && !open) button.current?.focus();
    was.current = open;
  }, [open]);
  return button;
}
