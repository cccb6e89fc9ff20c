/** Collapsible cards. A collapsed card draws nothing, and stays collapsed for this device type. */
import { createContext, type ComponentChildren } from "preact";
import { useContext, useEffect, useId, useMemo, useRef, useState } from "preact/hooks";

interface Fold {
  id: string;
  close: () => void;
}

/** The state of the enclosing collapsible card; `null` outside one. */
const CollapseContext = createContext<Fold | null>(null);

/** On a phone, optional cards are initially collapsed to save space. */
const NARROW = "(max-width: 48rem)";

interface FoldableProps {
  /** Storage key of the card; `type`: device type. */
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
  // Toggling replaces the button, so move the focus to the new one.
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

/** A card's title; a button if the card is collapsible. */
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
    // Reset the width to its initial value.
  }
}
