/** Cards that can be folded away. What is folded draws nothing, and stays folded for this type of device. */
import { createContext, type ComponentChildren } from "preact";
import { useContext, useEffect, useId, useMemo, useRef, useState } from "preact/hooks";

interface Fold {
  id: string;
  close: () => void;
}

/** Of the card that is folded by the button in its head; `null` where it is none. */
export const CollapseContext = createContext<Fold | null>(null);

/** There is no room for everything on a phone: what one may live without is folded there at first. */
const NARROW = "(max-width: 48rem)";

interface FoldableProps {
  /** Of the card, for what is remembered; `type`: of the device. */
  name: string;
  type: string;
  title: string;
  /** Open on a phone too, unless the user has collapsed it. */
  always?: boolean;
  children: ComponentChildren;
}

export function CollapsibleCard({ name, type, title, always = false, children }: FoldableProps) {
  const key = `telescope:fold:${type}:${name}`;
  const [open, setOpen] = useState(() => remembered(key) ?? (always || !matchMedia(NARROW).matches));
  const id = useId();
  const pressed = useRef(false);
  const turn = (next: boolean): void => {
    pressed.current = true;
    setOpen(next);
    remember(key, next);
  };
  // The button that was pressed is another one now: it keeps the focus.
  useEffect(() => {
    if (pressed.current) document.getElementById(id)?.focus();
    pressed.current = false;
  }, [open]);
  const fold = useMemo(() => ({ id, close: () => turn(false) }), [id, key]);
  if (!open) {
    return (
      <section class="card folded">
        <h2>
          <button type="button" class="fold" id={id} aria-expanded="false" data-testid={`fold-${name}`} onClick={() => turn(true)}>
            {title}
          </button>
        </h2>
      </section>
    );
  }
  return <CollapseContext.Provider value={fold}>{children}</CollapseContext.Provider>;
}

/** A card's title: a button where the card can be folded. */
export function CollapsibleTitle({ title }: { title: string }) {
  const fold = useContext(CollapseContext);
  if (fold === null) return <>{title}</>;
  return (
    <button type="button" class="fold" id={fold.id} aria-expanded="true" onClick={fold.close}>
      {title}
    </button>
  );
}

function remembered(key: string): boolean | null {
  try {
    const found = localStorage.getItem(key);
    return found === null ? null : found === "open";
  } catch {
    return null; // A browser that keeps nothing.
  }
}

function remember(key: string, open: boolean): void {
  try {
    localStorage.setItem(key, open ? "open" : "folded");
  } catch {
    // Then it is as wide as it was at first the next time.
  }
}
