import { useComputed } from "@preact/signals";
import { format } from "../i18n/format";
import { clock } from "../lib/clock";

/** The age of a time `at` on the page's clock; updates automatically. */
export function Age({ at, as = (age) => age }: { at: number; as?: (age: string) => string }) {
  const text = useComputed(() => as(format.age(Math.max(0, clock.value - at))));
  return <>{text}</>;
}
