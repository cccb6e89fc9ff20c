import type { ComponentChildren } from "preact";
import { useId } from "preact/hooks";
import { CollapsibleTitle } from "./collapsible-card";

interface CardProps {
  title: string;
  class?: string;
  /** Content next to the title, such as a note. */
  aside?: ComponentChildren;
  "data-testid"?: string;
  children: ComponentChildren;
}

export function Card({ title, aside, children, ...rest }: CardProps) {
  const id = useId();
  return (
    <section class={`card ${rest.class ?? ""}`} aria-labelledby={id} data-testid={rest["data-testid"]}>
      <header class="card-head">
        <h2 id={id}>
          <CollapsibleTitle title={title} />
        </h2>
        {aside}
      </header>
      {children}
    </section>
  );
}
