import { useComputed } from "@preact/signals";
import { format } from "../i18n/format";
import { clock } from "../lib/clock";

/** How long ago a moment of the page's clock was; it grows by itself. */
export function Age({ at, as = (age) => age }: { at: number; as?: (age: string) => string }) {
  const text = useComputed(() => as(format.age(Math.max(0, clock.value - at))));
  return <>{text}</>;
}
