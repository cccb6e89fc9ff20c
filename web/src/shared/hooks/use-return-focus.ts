import { useEffect, useRef } from "preact/hooks";
import type { RefObject } from "preact";

/** For the button that opens something in place: it has the focus again once that is closed. */
export function useReturnFocus(open: boolean): RefObject<HTMLButtonElement | null> {
  const button = useRef<HTMLButtonElement>(null);
  const was = useRef(open);
  useEffect(() => {
    if (was.current && !open) button.current?.focus();
    was.current = open;
  }, [open]);
  return button;
}
