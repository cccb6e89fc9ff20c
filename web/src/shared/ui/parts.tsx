/** Small parts that several pages use. */
import type { ComponentChildren } from "preact";
import { useComputed } from "@preact/signals";
import { useId } from "preact/hooks";
import { clock } from "../lib/clock";
import type { DeviceStore } from "../../features/devices/model/device-store";
import { common } from "../i18n/common";
import { format } from "../i18n/format";
import { CollapsibleTitle } from "./collapsible-card";

interface CardProps {
  title: string;
  class?: string;
  /** Beside the title: a note, a choice. */
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

/** Online, stale, offline or unknown, with the age of the device's last word. */
export function ReachChip({ device, ...rest }: { device: DeviceStore; "data-testid"?: string }) {
  const reach = device.reach.value;
  return (
    <span class={`chip reach-${reach}`} data-status={reach} title={common.reachExplained[reach]} {...rest}>
      <span class="dot" aria-hidden="true" />
      {common.reach[reach]}
    </span>
  );
}

/** The age of the device's last word; it grows by itself. */
export function LastSeenAge({ device }: { device: DeviceStore }) {
  // A signal in the text: with two hundred devices on a page only the words that change are touched.
  const text = useComputed(() => {
    const heardAt = device.lastSeenAt.value;
    return heardAt === null ? common.never : format.age(Math.max(0, clock.value - heardAt));
  });
  return <>{text}</>;
}

/** How long ago a moment of the page's clock was; it grows by itself. */
export function Age({ at, as = (age) => age }: { at: number; as?: (age: string) => string }) {
  const text = useComputed(() => as(format.age(Math.max(0, clock.value - at))));
  return <>{text}</>;
}

interface ChoiceProps<T extends string> {
  label: string;
  value: T;
  options: readonly (readonly [T, string])[];
  onChange: (value: T) => void;
}

/** One of a few, shown side by side. */
export function Choice<T extends string>({ label, value, options, onChange }: ChoiceProps<T>) {
  const name = useId();
  return (
    <fieldset class="choice">
      <legend class="visually-hidden">{label}</legend>
      {options.map(([option, text]) => (
        <label key={option} class={option === value ? "chosen" : ""}>
          <input type="radio" name={name} checked={option === value} onChange={() => onChange(option)} />
          {text}
        </label>
      ))}
    </fieldset>
  );
}
