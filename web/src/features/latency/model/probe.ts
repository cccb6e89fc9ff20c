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

/** As many as in the papers. */
export const TIMES = 20;
/** So that one does not wait for the one before in some queue [ms]. */
const BETWEEN_MS = 100;
/** A single measurement of a room device is answered, or has failed, within this time [ms]. */
const SHOT_TIMEOUT_MS = 10_000;

/** `cloud`: the server by HTTP; `broker`: the broker over this page's own connection; `device`: a room device measures once. */
export type ProbeKind = "cloud" | "broker" | "device";

type Kind = Pick<LatencyBatch, "transport" | "path">;

export const KINDS: Readonly<Record<ProbeKind, Kind>> = {
  cloud: { transport: "http", path: "operator-cloud" },
  broker: { transport: "websocket", path: "operator-cloud" },
  device: { transport: "http", path: "operator-device" },
};

export interface Progress {
  way: ProbeKind;
  done: number;
  of: number;
}

interface Batch {
  way: ProbeKind;
  key: string;
  samples: readonly Sample[];
  stored: boolean;
}

const SHOOT = "shoot";

/** What can be asked of a device so that nothing moves. */
export function probeKindsOf(device: DeviceStore): ProbeKind[] {
  const canShoot = device.description.value?.actions.includes(SHOOT) === true;
  return canShoot && device.info.value.role !== "viewer" ? ["cloud", "broker", "device"] : ["cloud", "broker"];
}

export class LatencyProbe {
  readonly #api: Api;
  readonly #link: Link;
  readonly #device: DeviceStore;
  readonly #epoch: () => number | null;
  readonly #betweenMs: number;
  readonly #progress = signal<Progress | null>(null);
  readonly #batches = signal<readonly Batch[]>([]);
  readonly #why = signal("");
  #ended = new AbortController();

  /** What is being measured; `null`: nothing. */
  readonly progress: ReadonlySignal<Progress | null> = this.#progress;
  /** Why it ended early, or could not be stored; empty otherwise. */
  readonly why: ReadonlySignal<string> = this.#why;

  /** `epoch`: of the lease that this page holds, if it does. */
  constructor(api: Api, link: Link, device: DeviceStore, epoch: () => number | null, betweenMs = BETWEEN_MS) {
    this.#api = api;
    this.#link = link;
    this.#device = device;
    this.#epoch = epoch;
    this.#betweenMs = betweenMs;
  }

  /** What was measured here. */
  get lines(): Line[] {
    return this.#batches.value.map(({ way, samples }) => ({ ...KINDS[way], device: this.#device.id, samples, stored: 0 }));
  }

  /** Whether something was measured and is not stored. */
  get unstored(): boolean {
    return this.#progress.value === null && this.#batches.value.some(({ stored, samples }) => !stored && samples.length > 0);
  }

  /** Measure each way in turn, and store it. Until its end, or until `stop`. */
  async run(ways: readonly ProbeKind[]): Promise<void> {
    if (this.#progress.value !== null) return;
    this.#ended = new AbortController();
    const { signal: ended } = this.#ended;
    this.#why.value = "";
    for (const way of ways) {
      if (!ended.aborted) await this.#measure(way, ended);
    }
    this.#progress.value = null;
    await this.store();
  }

  /** End it; what was measured stays. */
  stop(): void {
    this.#ended.abort();
  }

  /** Store what is not. Who only watches adds nothing to a device's record. */
  async store(): Promise<void> {
    if (this.#device.info.value.role === "viewer") return;
    for (const batch of this.#batches.value) {
      if (batch.stored || batch.samples.length === 0) continue;
      const { transport, path } = KINDS[batch.way];
      try {
        const samples = batch.samples.map(({ atMs, ms }) => ({ at_ms: atMs, ms }));
        await this.#api.addLatency(this.#device.id, { transport, path, samples }, batch.key);
        this.#note({ ...batch, stored: true });
      } catch (error) {
        this.#why.value = sentence(error);
        return;
      }
    }
    if (this.#batches.value.every(({ stored }) => stored) && !this.#ended.signal.aborted) this.#why.value = "";
  }

  async #measure(way: ProbeKind, ended: AbortSignal): Promise<void> {
    let batch: Batch = { way, key: newId(), samples: [], stored: false };
    for (let done = 0; done < TIMES; done += 1) {
      if (ended.aborted) return;
      this.#progress.value = { way, done, of: TIMES };
      const atMs = Math.round(serverNow());
      const begun = now();
      try {
        await this.#once(way);
      } catch (error) {
        this.#why.value = sentence(error);
        return;
      }
      batch = { ...batch, samples: [...batch.samples, { atMs, ms: Math.round((now() - begun) * 1000) / 1000 }] };
      this.#note(batch);
      await new Promise((resolve) => setTimeout(resolve, this.#betweenMs));
    }
  }

  async #once(way: ProbeKind): Promise<void> {
    if (way === "cloud") return this.#api.latency.ask();
    if (way === "broker") return this.#link.ping();
    const asked = { epoch: this.#epoch(), waitFor: "done", timeoutMs: SHOT_TIMEOUT_MS } as const;
    const action = await this.#api.startAction(this.#device.id, { kind: SHOOT, streams: [] }, asked, newId());
    if (action.status !== "done") throw new Error(action.reason?.message ?? action.status);
  }

  #note(batch: Batch): void {
    this.#batches.value = [...this.#batches.value.filter(({ key }) => key !== batch.key), batch];
  }
}
