/** Uploads this page's latency samples in infrequent batches, each once. */
import type { LatencyBatch } from "../../../shared/api/types";
import { effect } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { now } from "../../../shared/lib/clock";
import { ApiError } from "../../../shared/api/http";
import { newId } from "../../../shared/lib/ids";
import type { RoundTrip } from "./round-trip";

const EVERY_MS = 10_000;
/** The cloud's limit per batch. */
const MAX_SAMPLES = 1_000;

/** Maximum number of pending batches; later ones are dropped. */
const MAX_PENDING = 6;

type Sample = LatencyBatch["samples"][number];

/** The key makes repeated sending idempotent. */
interface PendingBatch {
  key: string;
  batch: LatencyBatch;
}

export class LatencySamples {
  readonly #api: Api;
  readonly #device: string;
  readonly #timer: ReturnType<typeof setInterval>;
  readonly #disposeEffect: () => void;
  /** From a setpoint to the telemetry that echoes it, over the broker. */
  readonly #setpoints: Sample[] = [];
  /** From an HTTP call to its response: the uploads themselves. */
  readonly #calls: Sample[] = [];
  readonly #pending: PendingBatch[] = [];
  #sending = false;

  constructor(api: Api, device: string, roundTrip: RoundTrip, everyMs = EVERY_MS) {
    this.#api = api;
    this.#device = device;
    this.#timer = setInterval(() => void this.send(), everyMs);
    this.#disposeEffect = effect(() => {
      const latest = roundTrip.figures.value?.latestMs;
      if (latest !== undefined && this.#setpoints.length < MAX_SAMPLES) this.#setpoints.push({ at_ms: Date.now(), ms: latest });
    });
  }

  /** Sends the pending samples; a failed batch is sent again unchanged. */
  async send(): Promise<void> {
    if (this.#sending) return;
    this.#sending = true;
    if (this.#setpoints.length > 0) this.#enqueue("websocket", "operator-device", this.#setpoints.splice(0));
    if (this.#calls.length > 0) this.#enqueue("http", "operator-cloud", this.#calls.splice(0));
    for (const pending of this.#pending.splice(0)) await this.#post(pending);
    this.#sending = false;
  }

  dispose(): void {
    clearInterval(this.#timer);
    this.#disposeEffect();
    void this.send();
  }

  #enqueue(transport: LatencyBatch["transport"], path: LatencyBatch["path"], samples: readonly Sample[]): void {
    this.#pending.push({ key: newId(), batch: { transport, path, samples } });
  }

  async #post(pending: PendingBatch): Promise<void> {
    const requestedAt = now();
    try {
      await this.#api.addLatency(this.#device, pending.batch, pending.key);
      // These samples alone do not cause an upload.
      if (pending.batch.path === "operator-device") this.#calls.push({ at_ms: Date.now(), ms: now() - requestedAt });
    } catch (error) {
      // A rejected batch would be rejected again.
      const retryable = error instanceof ApiError && (error.status === 0 || error.status === 429 || error.status >= 500);
      if (retryable && this.#pending.length < MAX_PENDING) this.#pending.push(pending);
    }
  }
}
