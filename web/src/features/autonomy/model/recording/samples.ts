/** Rows of joint values over time, in columns, so that they are small and are found by binary search. */
import type { Mode } from "../../../../shared/mqtt/protocol.generated";

export const SOURCES = ["operator", "movement", "hold", "stop"] as const;
export type Source = (typeof SOURCES)[number];
export const MODES = ["idle", "streaming", "action", "holding", "stopped", "fault"] as const satisfies readonly Mode[];

/** A time between two samples that is longer than this many periods is a gap. */
export const GAP_PERIODS = 2.5;

/** Samples in order of time. Joint values are row by row, in the order of `joints`. */
export interface Samples {
  joints: readonly string[];
  /** Since the start of the session [s]. */
  time_s: Float64Array;
  position_rad: Float64Array;
  applied_rad: Float64Array;
  /** Index in `SOURCES`. */
  source: Uint8Array;
  /** Index in `MODES`. */
  mode: Uint8Array;
  /** Time between two samples [s]. */
  period_s: number;
}

/** A longer time between two samples is a gap [s]. */
export function gapOf({ period_s }: Pick<Samples, "period_s">): number {
  return GAP_PERIODS * period_s;
}

/** Index of the last time that is not later than `at_s`; -1: all are later. */
export function indexAt(times: Float64Array, at_s: number): number {
  let [low, high] = [0, times.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if ((times[middle] ?? Infinity) <= at_s) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

/** Index of the sample that is valid at a time; null in a gap, and before the first and after the last sample. */
export function sampleAt(samples: Pick<Samples, "time_s" | "period_s">, at_s: number): number | null {
  const index = indexAt(samples.time_s, at_s);
  const found = samples.time_s[index];
  return found !== undefined && at_s - found <= gapOf(samples) ? index : null;
}

/** Index of the sample that is nearest to a time; null if none is within a gap's length. */
export function nearestTo(samples: Pick<Samples, "time_s" | "period_s">, at_s: number): number | null {
  const before = indexAt(samples.time_s, at_s);
  const distance = (index: number): number => Math.abs((samples.time_s[index] ?? Infinity) - at_s);
  const nearest = distance(before) <= distance(before + 1) ? before : before + 1;
  return distance(nearest) <= gapOf(samples) ? nearest : null;
}

/** The joint values of one sample. */
export function rowOf(values: Float64Array, joints: number, index: number): Float64Array {
  return values.subarray(index * joints, (index + 1) * joints);
}
