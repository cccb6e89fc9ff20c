/** Collapsible cards. A collapsed card renders no content; the state is stored per device type. */
import { createContext, type ComponentChildren } from "preact";
import { useContext, useEffect, useId, useMemo, useRef, useState } from "preact/hooks";

interface CollapseState {
  id: string;
  close: () => void;
}

/** The state of the enclosing collapsible card; `null` outside one. */
const CollapseContext = createContext<CollapseState | null>(null);

/** On a phone, optional cards are initially collapsed to save space. */
const NARROW = "(max-width: 48rem)";

interface CollapsibleCardProps {
  /** Storage key of the card; `type`: device type. */
  name: string;
  type: string;
  title: string;
  /** Open on a phone too, unless the user has collapsed it. */
  always?: boolean;
  children: ComponentChildren;
}

export function CollapsibleCard({ name, type, title, always = false, children }: CollapsibleCardProps) {
  const key = `telescope:fold:${type}:${name}`;
  const [open, setOpen] = useState(() => readState(key) ?? (always || !matchMedia(NARROW).matches));
  const id = useId();
  const pressed = useRef(false);
  const toggle = (next: boolean): void => {
    pressed.current = true;
    setOpen(next);
    storeState(key, next);
  };
  // Toggling replaces the button, so move the focus to the new one.
  useEffect(() => {
    if (pressed.current) document.getElementById(id)?.focus();
    pressed.current = false;
  }, [open]);
  const collapse = useMemo(() => ({ id, close: () => toggle(false) }), [id, key]);
  if (!open) {
    return (
      <section class="card folded">
        <h2>
          <button type="button" class="fold" id={id} aria-expanded="false" data-testid={`fold-${name}`} onClick={() => toggle(true)}>
            {title}
          </button>
        </h2>
      </section>
    );
  }
  return <CollapseContext.Provider value={collapse}>{children}</CollapseContext.Provider>;
}

/** A card's title; a button if the card is collapsible. */
export function CollapsibleTitle({ title }: { title: string }) {
  const collapse = useContext(CollapseContext);
  if (collapse === null) return <>{title}</>;
  return (
    <button type="button" class="fold" id={collapse.id} aria-expanded="true" onClick={collapse.close}>
      {title}
    </button>
  );
}

function readState(key: string): boolean | null {
  try {
    const found = localStorage.getItem(key);
    return found === null ? null : found === "open";
  } catch {
    return null; // Storage is unavailable.
  }
}

function storeState(key: string, open: boolean): void {
  try {
    localStorage.setItem(key, open ? "open" : "folded");
  } catch {
    // Storage is full or unavailable: the state is lost when the page closes.
  }
}
