/**
 * Traces the last commands of this page: sent, accepted, started, observed, ended. Each step uses messages that this page
 * received, and its own clock. A setpoint stream is one line, like an action.
 */
import { type ActionRunner, ended, type Run, type RunStatus, type Step } from "../../actions/model";
import type { DeviceStore } from "../../devices/model";
import type { SetpointStreamer } from "../../steering/model";
import { computed, effect, signal, untracked, type ReadonlySignal } from "@preact/signals-core";
import { now } from "../../../shared/lib/clock";
import type { Control } from "./lease";
import { newId } from "../../../shared/lib/ids";
import { moves, type AnyRequest } from "../../../shared/api/action-requests";

export type TraceStatus = RunStatus | "observed";

/** How the command was observed: measured motion, or the device's reported state. */
export type ObservedBy = "motion" | "state";

export interface TraceLine {
  key: string;
  request: AnyRequest | { kind: "stream" };
  /** On the page's clock [ms]. */
  clickedAt: number;
  status: RunStatus;
  steps: readonly Step<TraceStatus>[];
  /** `null` until an effect is observed. */
  observedBy: ObservedBy | null;
  /** For an action, a sentence; for a stream, the streamer's end reason. */
  reason: string;
}

const MAX_LINES = 20;
/** Change since the click that counts as motion [rad; prismatic joints and bases: m]. */
const MOTION_THRESHOLD = 0.005;
/** A joint faster than this at the click was already moving [rad/s]. */
const MOVING_RAD_S = 0.02;
/** Telemetry up to this long after the end still counts as observation [ms]. */
const GRACE_MS = 400;
const ODOMETRY = "odometry";
const PLACE = ["x_m", "y_m", "yaw_rad"] as const;

export class CommandTrace {
  readonly #device: DeviceStore;
  readonly #observers = new Map<string, CommandObserver>();
  readonly #observations = signal<ReadonlyMap<string, Observation>>(new Map());
  readonly #streams = signal<readonly TraceLine[]>([]);
  readonly #unsubscribes: (() => void)[];

  /** The newest first. */
  readonly lines: ReadonlySignal<readonly TraceLine[]>;

  constructor(device: DeviceStore, control: Control, actions: ActionRunner) {
    this.#device = device;
    this.lines = computed(() => {
      const observations = this.#observations.value;
      const all = [...actions.runs.value.map(lineOf), ...this.#streams.value];
      return all
        .toSorted((a, b) => b.clickedAt - a.clickedAt)
        .slice(0, MAX_LINES)
        .map((line) => withObservation(line, observations.get(line.key)));
    });
    this.#unsubscribes = [
      effect(() => {
        for (const run of actions.runs.value) this.#track(run);
      }),
      effect(() => {
        const streamer = control.streamer.value;
        const state = streamer?.state.value ?? "idle";
        untracked(() => this.#trackStream(streamer, state !== "idle"));
      }),
      effect(() => {
        // Evaluate every device message on arrival.
        const messages = [device.telemetry.value, device.state.value, device.measured(ODOMETRY).value];
        if (messages.some((one) => one !== null)) untracked(() => this.#evaluate());
      }),
    ];
  }

  dispose(): void {
    for (const end of this.#unsubscribes) end();
    this.#observers.clear();
  }

  #track(run: Run): void {
    const observer = this.#observers.get(run.key);
    if (observer === undefined) {
      const done = ended(run) || this.#observations.peek().has(run.key);
      if (!done) this.#observers.set(run.key, untracked(() => new CommandObserver(this.#device, run.clickedAt, moves(run.request), "action")));
      return;
    }
    observer.action = run.id;
    if (ended(run) && observer.endedAt === null) observer.endedAt = now();
  }

  #trackStream(streamer: SetpointStreamer | null, running: boolean): void {
    const [newest] = this.#streams.value;
    const open = newest?.status === "sent" || newest?.status === "accepted" || newest?.status === "started";
    if (running && !open) {
      const line: TraceLine = {
        key: newId(),
        request: { kind: "stream" },
        clickedAt: now(),
        status: "sent",
        steps: [{ status: "sent", afterMs: 0, source: "page" }],
        observedBy: null,
        reason: "",
      };
      this.#observers.set(line.key, new CommandObserver(this.#device, line.clickedAt, true, "streaming"));
      this.#streams.value = [line, ...this.#streams.value].slice(0, MAX_LINES);
    }
    if (!running && open) {
      const reason = streamer?.ended.peek() ?? "";
      this.#addStreamStep(reason === "reached" ? "done" : "cancelled", "page", reason);
      const observer = this.#observers.get(newest.key);
      if (observer !== undefined) observer.endedAt = now();
    }
  }

  /** A step of the newest stream. */
  #addStreamStep(status: RunStatus, source: Step["source"], reason = ""): void {
    const [newest, ...others] = this.#streams.value;
    if (newest === undefined || newest.steps.some((step) => step.status === status)) return;
    const step = { status, afterMs: now() - newest.clickedAt, source };
    this.#streams.value = [{ ...newest, status, reason, steps: [...newest.steps, step] }, ...others];
  }

  #evaluate(): void {
    this.#evaluateStream();
    for (const [key, observer] of this.#observers) {
      const observation = observer.observe();
      if (observation !== null) this.#observations.value = new Map([...this.#observations.value].slice(-2 * MAX_LINES)).set(key, observation);
      if (observation !== null || observer.finished()) this.#observers.delete(key);
    }
  }

  /** Telemetry that acknowledges a setpoint of this stream shows acceptance, and then motion. */
  #evaluateStream(): void {
    const [newest] = this.#streams.value;
    const message = this.#device.telemetry.value?.message;
    if (newest === undefined || message === undefined || newest.steps.some(({ status }) => status === "done" || status === "cancelled")) return;
    if (message.setpoint_sequence === 0 || message.setpoint_sent_ms < newest.clickedAt) return;
    this.#addStreamStep("accepted", "device");
    if (message.mode === "streaming") this.#addStreamStep("started", "device");
  }
}

interface Observation {
  afterMs: number;
  by: ObservedBy;
}

/** Observes the effect of one command: compares the device's pose and state with those at the click. */
class CommandObserver {
  readonly #device: DeviceStore;
  readonly #since: number;
  readonly #motion: boolean;
  readonly #mode: "action" | "streaming";
  #joints: readonly number[] | null = null;
  #place: readonly number[] | null = null;
  #stiffness: string;
  #changed: Observation | null = null;
  readonly #wasBusy: boolean;
  action: string | null = null;
  endedAt: number | null = null;

  /** `motion`: requires motion, unless none occurs until the end. `mode`: the mode that the device reports meanwhile. */
  constructor(device: DeviceStore, since: number, motion: boolean, mode: "action" | "streaming") {
    this.#device = device;
    this.#since = since;
    this.#motion = motion;
    this.#mode = mode;
    const message = device.telemetry.value?.message;
    this.#wasBusy = message?.mode === mode;
    this.#stiffness = JSON.stringify(device.state.value?.stiffness ?? {});
    // A joint that already moves has another cause: compare with its position when the command starts.
    if (message?.velocity_rad_s.every((velocity) => Math.abs(velocity) < MOVING_RAD_S) === true) this.#readPose();
  }

  /** The first observation; `null` before. */
  observe(): Observation | null {
    const telemetry = this.#device.telemetry.value;
    const state = this.#device.state.value;
    const at = now();
    const afterMs = at - this.#since;
    const current = telemetry !== null && telemetry.receivedAt >= this.#since;
    const inMode = current && telemetry.message.mode === this.#mode;
    if (this.#changed === null) {
      const reported = (inMode && !this.#wasBusy) || (this.action !== null && state?.action?.id === this.action);
      const stiffnessChanged = state !== null && JSON.stringify(state.stiffness) !== this.#stiffness;
      if (reported || (stiffnessChanged && !this.#motion)) this.#changed = { afterMs, by: "state" };
    }
    if (current && (inMode || this.endedAt !== null)) {
      if (this.#joints === null) this.#readPose();
      else if (this.#hasMoved(telemetry.message.position_rad)) return { afterMs, by: "motion" };
    }
    const sufficient = !this.#motion || this.finished();
    return sufficient ? this.#changed : null;
  }

  finished(): boolean {
    return this.endedAt !== null && now() - this.endedAt > GRACE_MS;
  }

  #readPose(): void {
    this.#joints = this.#device.telemetry.value?.message.position_rad ?? null;
    this.#place = placeOf(this.#device);
  }

  #hasMoved(position: readonly number[]): boolean {
    const joints = this.#joints ?? [];
    if (position.some((one, index) => Math.abs(one - (joints[index] ?? one)) > MOTION_THRESHOLD)) return true;
    const place = this.#place;
    const current = placeOf(this.#device);
    return current?.some((one, index) => Math.abs(one - (place?.[index] ?? one)) > MOTION_THRESHOLD) === true;
  }
}

function placeOf(device: DeviceStore): readonly number[] | null {
  const values = device.measured(ODOMETRY).value?.message.values;
  if (values === undefined) return null;
  return PLACE.map((name) => Number(values[name] ?? 0));
}

function lineOf({ key, request, clickedAt, status, steps, reason }: Run): TraceLine {
  return { key, request, clickedAt, status, steps, reason, observedBy: null };
}

function withObservation(line: TraceLine, observation: Observation | undefined): TraceLine {
  if (observation === undefined) return line;
  // Insert it before the end, independent of the order of arrival.
  const at = line.steps.findIndex(({ status }) => !["sent", "accepted", "started"].includes(status));
  const step = { status: "observed", afterMs: observation.afterMs, source: "device" } as const;
  return { ...line, observedBy: observation.by, steps: at < 0 ? [...line.steps, step] : line.steps.toSpliced(at, 0, step) };
}
