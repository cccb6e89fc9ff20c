/** One run of a movement, followed from the click to its end: by the acks of the device, and by asking the cloud. */
import { signal, type ReadonlySignal } from "@preact/signals-core";
import { ApiError, sentence, type Action, type ActionStatus, type Api } from "./api";
import type { DeviceStore } from "./device";
import { newId } from "./ids";
import type { KnownAck } from "./messages";

/** `sent`: asked for, and no answer yet. `refused`: the cloud said no. */
export type RunStatus = "sent" | "accepted" | "started" | "done" | "failed" | "expired" | "cancelled" | "refused";

export interface Run {
  movement: string;
  id: string | null;
  status: RunStatus;
  /** Times on the page's clock, from the click [ms], of the steps seen so far. */
  steps: readonly { status: RunStatus; afterMs: number }[];
  why: string;
  output: string;
  progress: number | null;
}

const RANK: Readonly<Record<RunStatus, number>> = {
  sent: 0,
  accepted: 1,
  started: 2,
  done: 3,
  failed: 3,
  expired: 3,
  cancelled: 3,
  refused: 3,
};
const POLL_MS = 10_000;
const RETRY_MS = 2_000;

function rank(status: ActionStatus): RunStatus {
  if (status === "queued" || status === "created" || status === "published" || status === "received") return "sent";
  return status;
}

export function ended(run: Run): boolean {
  return RANK[run.status] === 3;
}

export class ActionRunner {
  readonly #api: Api;
  readonly #device: DeviceStore;
  readonly #run = signal<Run | null>(null);
  #endAcks: () => void = () => undefined;
  #clickedAt = 0;
  #disposed = false;

  /** The newest run started from this page; it stays after its end. */
  readonly run: ReadonlySignal<Run | null> = this.#run;

  constructor(api: Api, device: DeviceStore) {
    this.#api = api;
    this.#device = device;
  }

  /** Start a movement: under our lease where there is one, else under one that the cloud takes for this run. */
  async start(movement: string, epoch: number | null): Promise<void> {
    this.#endAcks();
    this.#clickedAt = performance.now();
    const run: Run = { movement, id: null, status: "sent", steps: [], why: "", output: "", progress: null };
    this.#run.value = { ...run, steps: [{ status: "sent", afterMs: 0 }] };
    try {
      const action = await this.#api.runMovement(this.#device.id, movement, epoch, newId());
      if (this.#disposed) return;
      this.#update({ id: action.id });
      this.#endAcks = this.#device.onAck(action.id, (ack) => this.#hearAck(ack));
      this.#hear(action);
      void this.#poll(action.id);
    } catch (error) {
      this.#advance("refused", { why: sentence(error) });
    }
  }

  /** End our own run, or the action `other` that somebody else started. */
  async cancel(other: string | null): Promise<void> {
    const id = other ?? this.#run.value?.id;
    if (id === undefined || id === null) return;
    try {
      await this.#api.cancelAction(id);
    } catch (error) {
      this.#update({ why: sentence(error) });
    }
  }

  dispose(): void {
    this.#disposed = true;
    this.#endAcks();
  }

  /** The device's own acks are quicker; asking covers what this page did not hear. */
  async #poll(id: string): Promise<void> {
    while (!this.#disposed && this.#run.value?.id === id && !ended(this.#run.value)) {
      try {
        this.#hear(await this.#api.action(id, POLL_MS));
      } catch (error) {
        if (error instanceof ApiError && error.status === 404) return;
        await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
      }
    }
  }

  #hear(action: Action): void {
    if (this.#run.value?.id !== action.id) return;
    this.#advance(rank(action.status), {
      why: action.reason?.message ?? "",
      output: longer(action.output, this.#run.value.output),
      progress: action.progress ?? this.#run.value.progress,
    });
  }

  #hearAck(ack: KnownAck): void {
    const run = this.#run.value;
    if (run?.id !== ack.id) return;
    this.#advance(rank(ack.status), {
      why: ack.reason?.message ?? run.why,
      output: longer(ack.output, run.output),
      progress: ack.progress ?? run.progress,
    });
  }

  /** The status never goes back and the first end stays; a step that is told late still finds its place. */
  #advance(status: RunStatus, rest: Partial<Run>): void {
    const run = this.#run.value;
    if (run === null) return;
    const forward = RANK[status] > RANK[run.status];
    this.#run.value = {
      ...run,
      ...rest,
      status: forward ? status : run.status,
      steps: withStep(run.steps, status, performance.now() - this.#clickedAt),
    };
  }

  #update(rest: Partial<Run>): void {
    if (this.#run.value !== null) this.#run.value = { ...this.#run.value, ...rest };
  }
}

function withStep(steps: Run["steps"], status: RunStatus, afterMs: number): Run["steps"] {
  const after = steps.findIndex((step) => RANK[step.status] >= RANK[status]);
  if (after < 0) return [...steps, { status, afterMs }];
  const next = steps[after];
  // Known already, or another end than the first.
  if (next === undefined || RANK[next.status] === RANK[status]) return steps;
  // The answer overtook the ack: it cannot have been later than what followed it.
  return steps.toSpliced(after, 0, { status, afterMs: Math.min(afterMs, next.afterMs) });
}

/** Output only grows; the cloud and the device may tell it at different lengths. */
function longer(one: string, other: string): string {
  return one.length >= other.length ? one : other;
}
