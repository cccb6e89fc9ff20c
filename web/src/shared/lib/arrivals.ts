/** Arrival times of the messages of a stream, and when a stream is late. */

/** Margin for the network and for the clock of the page [ms]. */
const LATE_MS = 1_000;
const PERIODS = 3;
/** Averaging time of the rate [ms]. */
const RATE_OVER_MS = 3_000;

/**
 * The age from which data of a stream is late: three periods plus one second [ms]. An agent with a high load sends less
 * often than it declares, so the longer of the declared and the observed period counts. `everyMs`: `null` if not observed.
 */
export function lateAfterMs(rateHz: number, everyMs: number | null): number {
  return LATE_MS + PERIODS * Math.max(1000 / rateHz, everyMs ?? 0);
}

/** Measures the rate and the period of a stream from the arrivals on the page's clock [ms]. */
export class Arrivals {
  /** Those of the averaging time. */
  #recent: readonly number[] = [];
  /** The newest three. */
  #newest: readonly number[] = [];

  add(at: number): void {
    this.#recent = [...this.#recent.filter((one) => one > at - RATE_OVER_MS), at];
    this.#newest = [...this.#newest.slice(-2), at];
  }

  /** The shorter of the last two intervals, so that one interruption does not count [ms]; `null` before the third arrival. */
  get everyMs(): number | null {
    const [first, second, third] = this.#newest;
    if (first === undefined || second === undefined || third === undefined) return null;
    return Math.min(second - first, third - second);
  }

  /** The mean rate [Hz]. */
  rateHz(at: number): number {
    const spanMs = Math.min(RATE_OVER_MS, at - (this.#recent[0] ?? at));
    return Math.max(0, this.#recent.length - 1) / Math.max(0.5, spanMs / 1000);
  }
}
