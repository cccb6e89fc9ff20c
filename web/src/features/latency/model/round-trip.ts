/** Time from sending a setpoint to the telemetry that echoes it, on this page's clock. */
import { signal, type ReadonlySignal } from "@preact/signals-core";

interface RoundTripFigures {
  latestMs: number;
  medianMs: number;
  p95Ms: number;
  samples: number;
}

/** Nearest-rank percentile of sorted values, `share` in 0…1. */
export function percentile(sorted: readonly number[], share: number): number {
  const rank = Math.max(1, Math.ceil(share * sorted.length));
  return sorted[rank - 1] ?? NaN;
}

/** Statistics of the newest samples; `null` without one. */
export class RoundTrip {
  readonly #window: number;
  readonly #samples: number[] = [];
  readonly #figures = signal<RoundTripFigures | null>(null);
  #lastSequence = 0;

  constructor(window = 200) {
    this.#window = window;
  }

  get figures(): ReadonlySignal<RoundTripFigures | null> {
    return this.#figures;
  }

  /** Telemetry echoes a setpoint of this page. Each sequence number counts once. */
  add(sequence: number, sentMs: number, nowMs: number): void {
    const tookMs = nowMs - sentMs;
    if (sequence <= this.#lastSequence || tookMs < 0) return;
    this.#lastSequence = sequence;
    this.#samples.push(tookMs);
    if (this.#samples.length > this.#window) this.#samples.shift();
    const sorted = this.#samples.toSorted((a, b) => a - b);
    this.#figures.value = {
      latestMs: tookMs,
      medianMs: percentile(sorted, 0.5),
      p95Ms: percentile(sorted, 0.95),
      samples: sorted.length,
    };
  }

  /** Starts a new lease, which restarts the sequence numbers. */
  restart(): void {
    this.#lastSequence = 0;
    this.#samples.length = 0;
    this.#figures.value = null;
  }
}
