/** Label and unit of a measured value, from the room's description or from its name. */
import { degrees } from "../../../shared/lib/angles";
import type { KnownDescription, KnownDiagnostic } from "../../../shared/mqtt/parse-messages";

export interface Quantity {
  stream: string;
  field: string;
  label: string;
  /** The displayed unit: degrees for angles. */
  unit: string;
  /** Converts from the message's unit to the displayed unit. */
  toDisplay: (value: number) => number;
  /** The limits from the description; `null`: none. */
  limits: KnownDiagnostic | null;
}

const identity = (value: number): number => value;

/** Units by name suffix; the longest match applies. */
const UNITS: readonly (readonly [string, string, (value: number) => number])[] = [
  ["rad_s", "°/s", degrees],
  ["percent", "%", identity],
  ["m_s", "m/s", identity],
  ["rad", "°", degrees],
  ["ppm", "ppm", identity],
  ["lux", "lx", identity],
  ["nm", "N m", identity],
  ["db", "dB", identity],
  ["ms", "ms", identity],
  ["hz", "Hz", identity],
  ["m", "m", identity],
  ["s", "s", identity],
  ["c", "°C", identity],
  ["v", "V", identity],
  ["a", "A", identity],
  ["w", "W", identity],
];

/** Label, unit and limits of one field. */
export function quantityOf(description: Pick<KnownDescription, "controls" | "diagnostics">, stream: string, field: string): Quantity {
  const [name = field, ...part] = field.split(".");
  const limits = description.diagnostics.find((one) => (one.stream === "" || one.stream === stream) && fits(one.fields, field)) ?? null;
  const control = description.controls.find((one) => one.name === field);
  const found = UNITS.find(([end]) => name === end || name.endsWith(`_${end}`));
  const share = control !== undefined && (control.unit ?? "") === "" && control.lower === 0 && control.upper === 1;
  if (share) return { stream, field, label: control.label, unit: "%", toDisplay: (value) => value * 100, limits };
  const declaredUnit = control?.unit ?? (limits?.unit === "" ? undefined : limits?.unit);
  const unit = declaredUnit === "rad" || declaredUnit === undefined ? (found?.[1] ?? (declaredUnit === "rad" ? "°" : "")) : declaredUnit;
  const toDisplay = declaredUnit === "rad" ? degrees : declaredUnit === undefined ? (found?.[2] ?? identity) : identity;
  const nameWithoutUnit = found === undefined ? name : name.slice(0, -found[0].length);
  const words = nameWithoutUnit.replaceAll("_", " ").trim();
  const ownLabel = control?.label ?? (words === "" ? name : words.charAt(0).toUpperCase() + words.slice(1));
  // A label for all fields of a stream does not identify a single field.
  const label = limits !== null && limits.fields !== "*" && part.length === 0 ? limits.label : [ownLabel, ...part].join(" · ");
  return { stream, field, label, unit, toDisplay, limits };
}

/** Whether a pattern, in which `*` matches any text, matches a field. */
function fits(pattern: string, field: string): boolean {
  const parts = pattern.split("*").map((part) => part.replace(/[.+?^${}()|[\]\\]/g, "\\$&"));
  return new RegExp(`^${parts.join(".*")}$`).test(field);
}

type Assessment = "normal" | "warning" | "outside";

/** Compares a value with its limits. */
export function assess(value: number, limits: KnownDiagnostic | null): Assessment {
  if (limits === null) return "normal";
  const { low, high, warning_low: warningLow, warning_high: warningHigh } = limits;
  if ((low !== null && value < low) || (high !== null && value > high)) return "outside";
  if ((warningLow !== null && value < warningLow) || (warningHigh !== null && value > warningHigh)) return "warning";
  return "normal";
}

/** Decimal places for a range, so that its limits differ in the third digit. */
export function digits(spread: number): number {
  if (!(spread > 0)) return 1;
  return Math.min(3, Math.max(0, 2 - Math.floor(Math.log10(spread))));
}
