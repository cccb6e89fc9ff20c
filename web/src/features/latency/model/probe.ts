/** Measures latency now by sequential requests without motion, on this page's clock. */
import type { LatencyBatch } from "../../../shared/api/types";
import type { DeviceStore } from "../../devices/model";
import type { Sample } from "../../../shared/api/latency";
import { signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { now, serverNow } from "../../../shared/lib/clock";
import { sentence } from "../../../shared/api/http";
import { newId } from "../../../shared/lib/ids";
import type { Link } from "../../../shared/mqtt/mqtt-link";
import type { Line } from "./latency-stats";

/** As in the papers. */
export const SAMPLES_PER_KIND = 20;
/** Avoids queueing behind the previous request [ms]. */
const PAUSE_MS = 100;
/** Timeout of a single measurement of a room device [ms]. */
const SHOT_TIMEOUT_MS = 10_000;

/** `cloud`: the server by HTTP; `broker`: the broker over this page's own connection; `device`: a room device measures once. */
export type ProbeKind = "cloud" | "broker" | "device";

type Kind = Pick<LatencyBatch, "transport" | "path">;

const KINDS: Readonly<Record<ProbeKind, Kind>> = {
  cloud: { transport: "http", path: "operator-cloud" },
  broker: { transport: "websocket", path: "operator-cloud" },
  device: { transport: "http", path: "operator-device" },
};

interface Progress {
  kind: ProbeKind;
  done: number;
  total: number;
}

interface Batch {
  kind: ProbeKind;
  key: string;
  samples: readonly Sample[];
  stored: boolean;
}

const SHOOT = "shoot";

/** The probes that a device supports without motion. */
export function probeKindsOf(device: DeviceStore): ProbeKind[] {
  const canShoot = device.description.value?.actions.includes(SHOOT) === true;
  return canShoot && device.info.value.role !== "viewer" ? ["cloud", "broker", "device"] : ["cloud", "broker"];
}

export class LatencyProbe {
  readonly #api: Api;
  readonly #link: Link;
  readonly #device: DeviceStore;
  readonly #epoch: () => number | null;
  readonly #pauseMs: number;
  readonly #progress = signal<Progress | null>(null);
  readonly #batches = signal<readonly Batch[]>([]);
  readonly #error = signal("");
  #abort = new AbortController();

  /** The running measurement; `null`: none. */
  readonly progress: ReadonlySignal<Progress | null> = this.#progress;
  /** Why it ended early or could not be stored; empty otherwise. */
  readonly error: ReadonlySignal<string> = this.#error;

  /** `epoch`: the epoch of this page's lease, if any. */
  constructor(api: Api, link: Link, device: DeviceStore, epoch: () => number | null, pauseMs = PAUSE_MS) {
    this.#api = api;
    this.#link = link;
    this.#device = device;
    this.#epoch = epoch;
    this.#pauseMs = pauseMs;
  }

  get lines(): Line[] {
    return this.#batches.value.map(({ kind, samples }) => ({ ...KINDS[kind], device: this.#device.id, samples, stored: 0 }));
  }

  /** Whether samples are not stored yet. */
  get unstored(): boolean {
    return this.#progress.value === null && this.#batches.value.some(({ stored, samples }) => !stored && samples.length > 0);
  }

  /** Measures and stores each path in turn, until the end or `stop`. */
  async run(kinds: readonly ProbeKind[]): Promise<void> {
    if (this.#progress.value !== null) return;
    this.#abort = new AbortController();
    const { signal: ended } = this.#abort;
    this.#error.value = "";
    for (const kind of kinds) {
      if (!ended.aborted) await this.#measure(kind, ended);
    }
    this.#progress.value = null;
    await this.store();
  }

  /** Stops; the samples stay. */
  stop(): void {
    this.#abort.abort();
  }

  /** Stores pending samples. Viewers cannot store any. */
  async store(): Promise<void> {
    if (this.#device.info.value.role === "viewer") return;
    for (const batch of this.#batches.value) {
      if (batch.stored || batch.samples.length === 0) continue;
      const { transport, path } = KINDS[batch.kind];
      try {
        const samples = batch.samples.map(({ atMs, ms }) => ({ at_ms: atMs, ms }));
        await this.#api.addLatency(this.#device.id, { transport, path, samples }, batch.key);
        this.#setBatch({ ...batch, stored: true });
      } catch (error) {
        this.#error.value = sentence(error);
        return;
      }
    }
    if (this.#batches.value.every(({ stored }) => stored) && !this.#abort.signal.aborted) this.#error.value = "";
  }

  async #measure(kind: ProbeKind, ended: AbortSignal): Promise<void> {
    let batch: Batch = { kind, key: newId(), samples: [], stored: false };
    for (let done = 0; done < SAMPLES_PER_KIND; done += 1) {
      if (ended.aborted) return;
      this.#progress.value = { kind, done, total: SAMPLES_PER_KIND };
      const atMs = Math.round(serverNow());
      const started = now();
      try {
        await this.#sample(kind);
      } catch (error) {
        this.#error.value = sentence(error);
        return;
      }
      batch = { ...batch, samples: [...batch.samples, { atMs, ms: Math.round((now() - started) * 1000) / 1000 }] };
      this.#setBatch(batch);
      await new Promise((resolve) => setTimeout(resolve, this.#pauseMs));
    }
  }

  async #sample(kind: ProbeKind): Promise<void> {
    if (kind === "cloud") return this.#api.latency.measureRoundTrip();
    if (kind === "broker") return this.#link.ping();
    const options = { epoch: this.#epoch(), waitFor: "done", timeoutMs: SHOT_TIMEOUT_MS } as const;
    const action = await this.#api.startAction(this.#device.id, { kind: SHOOT, streams: [] }, options, newId());
    if (action.status !== "done") throw new Error(action.reason?.message ?? action.status);
  }

  #setBatch(batch: Batch): void {
    this.#batches.value = [...this.#batches.value.filter(({ key }) => key !== batch.key), batch];
  }
}
