/** The autonomy of a device over time, in bars of whole days (UTC), as the server counts them. */
import type { Autonomy } from "../../../shared/api/autonomy";

const DAY_MS = 86_400_000;

/** Length of a time span and of one bar of its chart [days]. Each span ends today. */
export const SPANS = {
  day: { days: 1, daysPerBar: 1 },
  week: { days: 7, daysPerBar: 1 },
  month: { days: 30, daysPerBar: 1 },
  year: { days: 364, daysPerBar: 7 },
} as const;
export type Span = keyof typeof SPANS;

/** Moving time in one or several days. */
export interface Bar {
  /** First moment in UTC [ms since 1970]. */
  startMs: number;
  /** Start of its last day [ms since 1970]. */
  lastDayMs: number;
  operatorS: number;
  machineS: number;
}

/** First moment of the first day of a span [ms since 1970]. */
export function startOf(span: Span, nowMs: number): number {
  return (Math.floor(nowMs / DAY_MS) - SPANS[span].days + 1) * DAY_MS;
}

/** All bars of a span in order of time, also those without motion. */
export function barsOf(days: Autonomy["days"], span: Span, nowMs: number): Bar[] {
  const { days: count, daysPerBar } = SPANS[span];
  const firstMs = startOf(span, nowMs);
  const bars = Array.from({ length: count / daysPerBar }, (_, index): Bar => {
    const startMs = firstMs + index * daysPerBar * DAY_MS;
    return { startMs, lastDayMs: startMs + (daysPerBar - 1) * DAY_MS, operatorS: 0, machineS: 0 };
  });
  for (const { at, share } of days) {
    const bar = bars[Math.floor((Date.parse(at) - firstMs) / DAY_MS / daysPerBar)];
    if (bar === undefined) continue;
    bar.operatorS += share.operator_s;
    bar.machineS += share.machine_s;
  }
  return bars;
}
