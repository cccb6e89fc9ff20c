/** The last seconds of a device's telemetry for plots. */
import type { KnownTelemetry } from "../../../shared/mqtt/parse-messages";

export const SPAN_MS = 20_000;
/** A pause longer than this is drawn as a gap [ms]. */
const GAP_MS = 1_000;

export type Quantity = "position_rad" | "velocity_rad_s" | "effort_nm";

interface Sample {
  at: number;
  message: KnownTelemetry | null;
}

export class RecentTelemetry {
  readonly #samples: Sample[] = [];

  add(message: KnownTelemetry, at: number): void {
    const last = this.#samples.at(-1);
    if (last !== undefined && at - last.at > GAP_MS) this.#samples.push({ at: last.at + 1, message: null });
    this.#samples.push({ at, message });
    const oldest = at - SPAN_MS - GAP_MS;
    const keepFrom = this.#samples.findIndex((sample) => sample.at >= oldest);
    // In blocks, to avoid moving the array for every message.
    if (keepFrom > 100) this.#samples.splice(0, keepFrom);
  }

  /** Times relative to `now` [s], then one column for each requested joint; `null` marks a gap. */
  columns(quantity: Quantity, joints: readonly number[], now: number): [number[], ...(number | null)[][]] {
    const from = this.#samples.findIndex((sample) => sample.at >= now - SPAN_MS);
    const shown = from < 0 ? [] : this.#samples.slice(from);
    return [
      shown.map((sample) => (sample.at - now) / 1000),
      ...joints.map((joint) => shown.map((sample) => sample.message?.[quantity][joint] ?? null)),
    ];
  }
}
