/** A measured field: the stored series and the live measurements since. */
import type { Series } from "../../../shared/api/types";

interface Sample {
  /** On the agent's wall clock [ms since 1970]. */
  at: number;
  mean: number;
  low: number;
  high: number;
}

const MAX_LIVE = 20_000;

export class Recording {
  #stored: Sample[] = [];
  #live: Sample[] = [];
  #spanMs = 0;

  /** Merges the stored series. Live measurements have a higher resolution, so they stay. */
  load(series: Series, field: string): void {
    const column = series.fields[field];
    this.#spanMs = series.span_ms;
    this.#stored = series.at_ms.flatMap((at, index) => {
      const mean = column?.mean[index];
      if (mean === undefined || mean === null) return [];
      return [{ at, mean, low: column?.min[index] ?? mean, high: column?.max[index] ?? mean }];
    });
  }

  add(at: number, value: number): void {
    if (at <= (this.#live.at(-1)?.at ?? -Infinity)) return;
    this.#live.push({ at, mean: value, low: value, high: value });
    if (this.#live.length > MAX_LIVE) this.#live.splice(0, MAX_LIVE / 10);
  }

  /** Samples since a time, in order. */
  samples(sinceMs: number): Sample[] {
    const begin = this.#live[0]?.at ?? Infinity;
    return [...this.#stored.filter((one) => one.at < begin), ...this.#live].filter((one) => one.at >= sinceMs);
  }

  /**
   * Plot columns: times [s], means, minima, maxima. A pause of three usual intervals is a gap. Buckets are drawn at
   * their centre.
   */
  columns(sinceMs: number): [number[], (number | null)[], (number | null)[], (number | null)[]] {
    const samples = this.samples(sinceMs);
    const pauses = samples.slice(1).map((one, index) => one.at - (samples[index]?.at ?? 0));
    const usual = [...pauses].sort((a, b) => a - b)[Math.floor(pauses.length * 0.9)] ?? 0;
    const out: [number[], (number | null)[], (number | null)[], (number | null)[]] = [[], [], [], []];
    const stored = new Set(this.#stored);
    samples.forEach((one, index) => {
      const pause = index === 0 ? 0 : (pauses[index - 1] ?? 0);
      if (pause > 3 * usual + 1000) {
        out[0].push((one.at - pause / 2) / 1000);
        for (const column of [out[1], out[2], out[3]]) column.push(null);
      }
      out[0].push((one.at + (stored.has(one) ? this.#spanMs / 2 : 0)) / 1000);
      out[1].push(one.mean);
      out[2].push(one.low);
      out[3].push(one.high);
    });
    return out;
  }

  /**
   * The start of the current state; with `atLeast`, the first known sample. A change inside a bucket counts at its end.
   * `null`: unknown.
   */
  since(): { at: number; atLeast: boolean } | null {
    const samples = this.samples(-Infinity);
    const newest = samples.at(-1);
    if (newest === undefined) return null;
    const now = newest.high;
    let at = newest.at;
    for (let index = samples.length - 1; index >= 0; index -= 1) {
      const one = samples[index];
      if (one === undefined) break;
      if (one.low !== now || one.high !== now) return { at, atLeast: false };
      at = one.at;
    }
    return { at, atLeast: true };
  }
}
