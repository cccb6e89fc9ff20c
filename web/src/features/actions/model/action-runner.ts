/**
 * Starts actions on a robot or room device and tracks each from the click to its end, by the device's acks and by
 * polling the cloud.
 */
import type { Action, ActionCallOptions, ActionStatus } from "../../../shared/api/types";
import type { DeviceStore } from "../../devices/model";
import { computed, effect, signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { now } from "../../../shared/lib/clock";
import { ApiError, sentence } from "../../../shared/api/http";
import { newId } from "../../../shared/lib/ids";
import type { KnownAck } from "../../../shared/mqtt/parse-messages";
import { undoRequestOf } from "./undo-request";
import type { AnyRequest } from "../../../shared/api/action-requests";

/**
 * `sent`: requested, no response yet. `unknown`: the device has not reported the outcome in time. `refused`: rejected by
 * the cloud. `unanswered`: the cloud was unreachable, so it is unknown whether the device received the request.
 */
export type RunStatus =
  | "sent"
  | "accepted"
  | "started"
  | "unknown"
  | "done"
  | "failed"
  | "expired"
  | "cancelled"
  | "refused"
  | "unanswered";

/** Source of a step: this page, the device's ack, or the cloud's response. */
export type StepSource = "page" | "device" | "cloud";

export interface Step<Status = RunStatus> {
  status: Status;
  /** Time since the click on the page's clock [ms]. */
  afterMs: number;
  source: StepSource;
}

export interface Run {
  /** Its Idempotency-Key: a repeated request counts once. */
  key: string;
  request: AnyRequest;
  /** On the page's clock [ms]. */
  clickedAt: number;
  id: string | null;
  status: RunStatus;
  /** The received steps, in order. */
  steps: readonly Step[];
  reason: string;
  output: string;
  progress: number | null;
  result: Readonly<Record<string, unknown>>;
  /** The request that undoes it, if any. */
  undo: AnyRequest | null;
}

export interface ActionOptions extends ActionCallOptions {
  /** The request that undoes it; by default the result of `undoRequestOf`. */
  undo?: AnyRequest;
  /** The cloud's response, if one call started actions on several devices. */
  response?: Promise<Action>;
}

const RANK: Readonly<Record<RunStatus, number>> = {
  sent: 0,
  accepted: 1,
  started: 2,
  unknown: 3,
  done: 4,
  failed: 4,
  expired: 4,
  cancelled: 4,
  refused: 4,
  unanswered: 4,
};
const MAX_RUNS = 20;
const POLL_MS = 10_000;
const RETRY_MS = 2_000;
/** A failed call is retried with the same key for at most this long, so that no motion starts unexpectedly [ms]. */
const RETRY_WITHIN_MS = 2_000;
/** The cloud releases the lease of a run this long after the run ends; the page then reads the holder again [ms]. */
const LEASE_REFRESH_DELAY_MS = 1_000;

function runStatusOf(status: ActionStatus): RunStatus {
  if (status === "queued" || status === "created" || status === "published" || status === "received") return "sent";
  return status;
}

export function ended({ status }: { status: RunStatus }): boolean {
  return RANK[status] === RANK.done;
}

/** Whether the run no longer occupies its device. */
export function released({ status }: { status: RunStatus }): boolean {
  return RANK[status] >= RANK.unknown;
}

export class ActionRunner {
  readonly #api: Api;
  readonly #device: DeviceStore;
  readonly #tracked = signal<readonly TrackedRun[]>([]);

  /** The last twenty actions, newest first, including ended ones. */
  readonly runs: ReadonlySignal<readonly Run[]> = computed(() => this.#tracked.value.map(({ run }) => run.value));
  /** The newest action of this page. */
  readonly run: ReadonlySignal<Run | null> = computed(() => this.runs.value[0] ?? null);

  constructor(api: Api, device: DeviceStore) {
    this.#api = api;
    this.#device = device;
  }

  /** Starts an action under this page's lease, or under one that the cloud takes for this run. */
  async start(request: AnyRequest, epoch: number | null, undo?: AnyRequest): Promise<Run> {
    return this.#track(request, undo === undefined ? { epoch } : { epoch, undo }).firstResponse;
  }

  /** Tracks an action that another call started; returns the run after that call's response. */
  async follow(request: AnyRequest, response: Promise<Action>): Promise<Run> {
    return this.#track(request, { epoch: null, response }).firstResponse;
  }

  /** Starts an action and waits for the requested status, the end or an unknown outcome. */
  async startAndWait(request: AnyRequest, options: ActionOptions): Promise<Run> {
    return this.#track(request, options).waitFor(options.waitFor === "started" ? "started" : "unknown");
  }

  /** Cancels the newest run of this page, or action `other` of another caller. Returns the error, or "". */
  async cancel(otherId: string | null): Promise<string> {
    const newest = this.#tracked.value[0];
    const id = otherId ?? newest?.run.value.id;
    if (id === undefined || id === null) return "";
    try {
      await this.#api.cancelAction(id);
      return "";
    } catch (error) {
      if (otherId === null) newest?.setReason(sentence(error));
      return sentence(error);
    }
  }

  dispose(): void {
    for (const tracked of this.#tracked.value) tracked.dispose();
  }

  #track(request: AnyRequest, options: ActionOptions): TrackedRun {
    const tracked = new TrackedRun(this.#api, this.#device, request, options);
    for (const oldest of this.#tracked.value.slice(MAX_RUNS - 1)) oldest.dispose();
    this.#tracked.value = [tracked, ...this.#tracked.value].slice(0, MAX_RUNS);
    return tracked;
  }
}

/** One request in progress. */
class TrackedRun {
  readonly #api: Api;
  readonly #device: DeviceStore;
  readonly #run;
  #endAcks: () => void = () => undefined;
  #disposed = false;

  readonly run: ReadonlySignal<Run>;
  /** The run after the cloud's first response. */
  readonly firstResponse: Promise<Run>;

  constructor(api: Api, device: DeviceStore, request: AnyRequest, options: ActionOptions) {
    this.#api = api;
    this.#device = device;
    this.#run = signal<Run>({
      key: newId(),
      request,
      clickedAt: now(),
      id: null,
      status: "sent",
      steps: [{ status: "sent", afterMs: 0, source: "page" }],
      reason: "",
      output: "",
      progress: null,
      result: {},
      undo: options.undo ?? undoRequestOf(device, request),
    });
    this.run = this.#run;
    this.firstResponse = this.#start(options);
    if (options.epoch !== null) return;
    void this.waitFor("unknown").then(() => setTimeout(() => void this.#refreshLease(), LEASE_REFRESH_DELAY_MS));
  }

  /** The run when it has started, or when it no longer occupies its device. */
  waitFor(status: "started" | "unknown"): Promise<Run> {
    return new Promise((resolve) => {
      const unsubscribe = effect(() => {
        const run = this.#run.value;
        if (RANK[run.status] < RANK[status] && !this.#disposed) return;
        queueMicrotask(() => unsubscribe());
        resolve(run);
      });
    });
  }

  async #refreshLease(): Promise<void> {
    if (!this.#disposed) await this.#device.refreshLease();
  }

  setReason(reason: string): void {
    this.#run.value = { ...this.#run.value, reason };
  }

  dispose(): void {
    this.#disposed = true;
    this.#endAcks();
    // Release all waiting callers.
    this.#run.value = { ...this.#run.value };
  }

  async #start(options: ActionOptions): Promise<Run> {
    try {
      const action = await this.#post(options);
      if (this.#disposed) return this.#run.value;
      this.#run.value = { ...this.#run.value, id: action.id };
      // Apply the device's acks first: they arrived before this response.
      this.#endAcks = this.#device.onAck(action.id, (ack, at) => this.#applyAck(ack, at));
      this.#applyResponse(action);
      void this.#poll(action.id);
    } catch (error) {
      const unreachable = error instanceof ApiError && error.status === 0;
      this.#advance(unreachable ? "unanswered" : "refused", { reason: sentence(error) }, "cloud", now());
    }
    return this.#run.value;
  }

  async #post(options: ActionOptions): Promise<Action> {
    if (options.response !== undefined) return options.response;
    const { request, key, clickedAt } = this.#run.value;
    try {
      return await this.#api.startAction(this.#device.id, request, options, key);
    } catch (error) {
      const retry = error instanceof ApiError && error.status === 0 && now() - clickedAt < RETRY_WITHIN_MS;
      if (!retry) throw error;
      return this.#api.startAction(this.#device.id, request, options, key);
    }
  }

  /** The device's acks are faster; polling covers acks that this page did not receive. */
  async #poll(id: string): Promise<void> {
    while (!this.#disposed && !ended(this.#run.value)) {
      try {
        this.#applyResponse(await this.#api.action(id, POLL_MS));
      } catch (error) {
        if (error instanceof ApiError && error.status === 404) {
          this.#advance("unanswered", { reason: sentence(error) }, "cloud", now());
          return;
        }
        await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
      }
    }
  }

  #applyResponse(action: Action): void {
    const run = this.#run.value;
    const result = Object.keys(action.result).length > 0 ? action.result : run.result;
    const update = { output: longer(action.output, run.output), progress: action.progress ?? run.progress, result };
    this.#advance(runStatusOf(action.status), { reason: action.reason?.message ?? "", ...update }, "cloud", now());
  }

  #applyAck(ack: KnownAck, at: number): void {
    const run = this.#run.value;
    const result = Object.keys(ack.result).length > 0 ? ack.result : run.result;
    const update = { output: longer(ack.output, run.output), progress: ack.progress ?? run.progress, result };
    const before = run.status === "unknown" ? "" : run.reason;
    this.#advance(runStatusOf(ack.status), { reason: ack.reason?.message ?? before, ...update }, "device", at);
  }

  /** The status never moves backwards and the first terminal status stays; a late step is inserted in order. */
  #advance(status: RunStatus, rest: Partial<Run>, source: StepSource, at: number): void {
    const run = this.#run.value;
    const forward = RANK[status] > RANK[run.status];
    const step = { status, afterMs: Math.max(0, at - run.clickedAt), source };
    this.#run.value = { ...run, ...rest, status: forward ? status : run.status, steps: withStep(run.steps, step) };
  }
}

function withStep(steps: Run["steps"], step: Step): Run["steps"] {
  const after = steps.findIndex(({ status }) => RANK[status] >= RANK[step.status]);
  if (after < 0) return [...steps, step];
  const next = steps[after];
  // A duplicate, or a second terminal status.
  if (next === undefined || RANK[next.status] === RANK[step.status]) return steps;
  // The response overtook the ack: the step cannot be later than its successor.
  return steps.toSpliced(after, 0, { ...step, afterMs: Math.min(step.afterMs, next.afterMs) });
}

/** Output only grows; the cloud and the device may report it with different lengths. */
function longer(one: string, other: string): string {
  return one.length >= other.length ? one : other;
}
