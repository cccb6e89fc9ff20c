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
  shown: (value: number) => number;
  /** The room's limits; `null`: none. */
  judged: KnownDiagnostic | null;
}

const same = (value: number): number => value;

/** Units by name suffix; the longest match applies. */
const UNITS: readonly (readonly [string, string, (value: number) => number])[] = [
  ["rad_s", "°/s", degrees],
  ["percent", "%", same],
  ["m_s", "m/s", same],
  ["rad", "°", degrees],
  ["ppm", "ppm", same],
  ["lux", "lx", same],
  ["nm", "N m", same],
  ["db", "dB", same],
  ["ms", "ms", same],
  ["hz", "Hz", same],
  ["m", "m", same],
  ["s", "s", same],
  ["c", "°C", same],
  ["v", "V", same],
  ["a", "A", same],
  ["w", "W", same],
];

/** Label, unit and limits of one field. */
export function quantityOf(description: Pick<KnownDescription, "controls" | "diagnostics">, stream: string, field: string): Quantity {
  const [name = field, ...part] = field.split(".");
  const judged = description.diagnostics.find((one) => (one.stream === "" || one.stream === stream) && fits(one.fields, field)) ?? null;
  const control = description.controls.find((one) => one.name === field);
  const found = UNITS.find(([end]) => name === end || name.endsWith(`_${end}`));
  const share = control !== undefined && (control.unit ?? "") === "" && control.lower === 0 && control.upper === 1;
  if (share) return { stream, field, label: control.label, unit: "%", shown: (value) => value * 100, judged };
  const told = control?.unit ?? (judged?.unit === "" ? undefined : judged?.unit);
  const unit = told === "rad" || told === undefined ? (found?.[1] ?? (told === "rad" ? "°" : "")) : told;
  const shown = told === "rad" ? degrees : told === undefined ? (found?.[2] ?? same) : same;
  const bare = found === undefined ? name : name.slice(0, -found[0].length);
  const words = bare.replaceAll("_", " ").trim();
  const plain = control?.label ?? (words === "" ? name : words.charAt(0).toUpperCase() + words.slice(1));
  // A label for all fields of a stream does not name one of them.
  const label = judged !== null && judged.fields !== "*" && part.length === 0 ? judged.label : [plain, ...part].join(" · ");
  return { stream, field, label, unit, shown, judged };
}

/** Whether a pattern, in which `*` matches any text, matches a field. */
function fits(pattern: string, field: string): boolean {
  const parts = pattern.split("*").map((part) => part.replace(/[.+?^${}()|[\]\\]/g, "\\$&"));
  return new RegExp(`^${parts.join(".*")}$`).test(field);
}

type Judgement = "well" | "warning" | "bad";

/** Compares a value with the room's limits. */
export function judge(value: number, judged: KnownDiagnostic | null): Judgement {
  if (judged === null) return "well";
  const { low, high, warning_low: warningLow, warning_high: warningHigh } = judged;
  if ((low !== null && value < low) || (high !== null && value > high)) return "bad";
  if ((warningLow !== null && value < warningLow) || (warningHigh !== null && value > warningHigh)) return "warning";
  return "well";
}

/** Decimal places for a range, so that its limits differ in the third digit. */
export function digits(spread: number): number {
  if (!(spread > 0)) return 1;
  return Math.min(3, Math.max(0, 2 - Math.floor(Math.log10(spread))));
}
