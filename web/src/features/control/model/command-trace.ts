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
export type SeenBy = "motion" | "state";

export interface TraceLine {
  key: string;
  request: AnyRequest | { kind: "stream" };
  /** On the page's clock [ms]. */
  clickedAt: number;
  status: RunStatus;
  steps: readonly Step<TraceStatus>[];
  /** `null` until an effect is observed. */
  seenBy: SeenBy | null;
  /** For an action, a sentence; for a stream, the streamer's end reason. */
  why: string;
}

const KEPT = 20;
/** Change since the click that counts as motion [rad; prismatic joints and bases: m]. */
const MOVED = 0.005;
/** A joint faster than this at the click was already moving [rad/s]. */
const UNDER_WAY_RAD_S = 0.02;
/** Telemetry up to this long after the end still counts as observation [ms]. */
const GRACE_MS = 400;
const ODOMETRY = "odometry";
const PLACE = ["x_m", "y_m", "yaw_rad"] as const;

export class CommandTrace {
  readonly #device: DeviceStore;
  readonly #watches = new Map<string, Watch>();
  readonly #seen = signal<ReadonlyMap<string, Seen>>(new Map());
  readonly #streams = signal<readonly TraceLine[]>([]);
  readonly #ends: (() => void)[];

  /** The newest first. */
  readonly lines: ReadonlySignal<readonly TraceLine[]>;

  constructor(device: DeviceStore, control: Control, actions: ActionRunner) {
    this.#device = device;
    this.lines = computed(() => {
      const seen = this.#seen.value;
      const every = [...actions.runs.value.map(lineOf), ...this.#streams.value];
      return every
        .toSorted((a, b) => b.clickedAt - a.clickedAt)
        .slice(0, KEPT)
        .map((line) => withSeen(line, seen.get(line.key)));
    });
    this.#ends = [
      effect(() => {
        for (const run of actions.runs.value) this.#attend(run);
      }),
      effect(() => {
        const streamer = control.streamer.value;
        const state = streamer?.state.value ?? "idle";
        untracked(() => this.#attendStream(streamer, state !== "idle"));
      }),
      effect(() => {
        // Evaluate every device message on arrival.
        const news = [device.telemetry.value, device.state.value, device.measured(ODOMETRY).value];
        if (news.some((one) => one !== null)) untracked(() => this.#look());
      }),
    ];
  }

  dispose(): void {
    for (const end of this.#ends) end();
    this.#watches.clear();
  }

  #attend(run: Run): void {
    const watch = this.#watches.get(run.key);
    if (watch === undefined) {
      const looked = ended(run) || this.#seen.peek().has(run.key);
      if (!looked) this.#watches.set(run.key, untracked(() => new Watch(this.#device, run.clickedAt, moves(run.request), "action")));
      return;
    }
    watch.action = run.id;
    if (ended(run) && watch.endedAt === null) watch.endedAt = now();
  }

  #attendStream(streamer: SetpointStreamer | null, running: boolean): void {
    const [newest] = this.#streams.value;
    const open = newest?.status === "sent" || newest?.status === "accepted" || newest?.status === "started";
    if (running && !open) {
      const line: TraceLine = {
        key: newId(),
        request: { kind: "stream" },
        clickedAt: now(),
        status: "sent",
        steps: [{ status: "sent", afterMs: 0, heard: "page" }],
        seenBy: null,
        why: "",
      };
      this.#watches.set(line.key, new Watch(this.#device, line.clickedAt, true, "streaming"));
      this.#streams.value = [line, ...this.#streams.value].slice(0, KEPT);
    }
    if (!running && open) {
      const why = streamer?.ended.peek() ?? "";
      this.#stream(why === "reached" ? "done" : "cancelled", "page", why);
      const watch = this.#watches.get(newest.key);
      if (watch !== undefined) watch.endedAt = now();
    }
  }

  /** A step of the newest stream. */
  #stream(status: RunStatus, heard: Step["heard"], why = ""): void {
    const [newest, ...others] = this.#streams.value;
    if (newest === undefined || newest.steps.some((step) => step.status === status)) return;
    const step = { status, afterMs: now() - newest.clickedAt, heard };
    this.#streams.value = [{ ...newest, status, why, steps: [...newest.steps, step] }, ...others];
  }

  #look(): void {
    this.#lookAtStream();
    for (const [key, watch] of this.#watches) {
      const seen = watch.look();
      if (seen !== null) this.#seen.value = new Map([...this.#seen.value].slice(-2 * KEPT)).set(key, seen);
      if (seen !== null || watch.over()) this.#watches.delete(key);
    }
  }

  /** Telemetry that acknowledges a setpoint of this stream shows acceptance, and then motion. */
  #lookAtStream(): void {
    const [newest] = this.#streams.value;
    const message = this.#device.telemetry.value?.message;
    if (newest === undefined || message === undefined || newest.steps.some(({ status }) => status === "done" || status === "cancelled")) return;
    if (message.setpoint_sequence === 0 || message.setpoint_sent_ms < newest.clickedAt) return;
    this.#stream("accepted", "device");
    if (message.mode === "streaming") this.#stream("started", "device");
  }
}

interface Seen {
  afterMs: number;
  by: SeenBy;
}

/** The device's pose at the click, and whether it has changed since. */
class Watch {
  readonly #device: DeviceStore;
  readonly #since: number;
  readonly #motion: boolean;
  readonly #mode: "action" | "streaming";
  #joints: readonly number[] | null = null;
  #place: readonly number[] | null = null;
  #stiffness: string;
  #changed: Seen | null = null;
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
    // A joint that already moves does so for another reason: compare with its position at the start.
    if (message?.velocity_rad_s.every((velocity) => Math.abs(velocity) < UNDER_WAY_RAD_S) === true) this.#take();
  }

  /** The first observation; `null` before. */
  look(): Seen | null {
    const telemetry = this.#device.telemetry.value;
    const state = this.#device.state.value;
    const at = now();
    const afterMs = at - this.#since;
    const fresh = telemetry !== null && telemetry.receivedAt >= this.#since;
    const doing = fresh && telemetry.message.mode === this.#mode;
    if (this.#changed === null) {
      const says = (doing && !this.#wasBusy) || (this.action !== null && state?.action?.id === this.action);
      const stiff = state !== null && JSON.stringify(state.stiffness) !== this.#stiffness;
      if (says || (stiff && !this.#motion)) this.#changed = { afterMs, by: "state" };
    }
    if (fresh && (doing || this.endedAt !== null)) {
      if (this.#joints === null) this.#take();
      else if (this.#moved(telemetry.message.position_rad)) return { afterMs, by: "motion" };
    }
    const wanted = !this.#motion || this.over();
    return wanted ? this.#changed : null;
  }

  over(): boolean {
    return this.endedAt !== null && now() - this.endedAt > GRACE_MS;
  }

  #take(): void {
    this.#joints = this.#device.telemetry.value?.message.position_rad ?? null;
    this.#place = placeOf(this.#device);
  }

  #moved(position: readonly number[]): boolean {
    const joints = this.#joints ?? [];
    if (position.some((one, index) => Math.abs(one - (joints[index] ?? one)) > MOVED)) return true;
    const place = this.#place;
    const here = placeOf(this.#device);
    return here?.some((one, index) => Math.abs(one - (place?.[index] ?? one)) > MOVED) === true;
  }
}

function placeOf(device: DeviceStore): readonly number[] | null {
  const values = device.measured(ODOMETRY).value?.message.values;
  if (values === undefined) return null;
  return PLACE.map((name) => Number(values[name] ?? 0));
}

function lineOf({ key, request, clickedAt, status, steps, why }: Run): TraceLine {
  return { key, request, clickedAt, status, steps, why, seenBy: null };
}

function withSeen(line: TraceLine, seen: Seen | undefined): TraceLine {
  if (seen === undefined) return line;
  // Insert it before the end, independent of the order of arrival.
  const at = line.steps.findIndex(({ status }) => !["sent", "accepted", "started"].includes(status));
  const step = { status: "observed", afterMs: seen.afterMs, heard: "device" } as const;
  return { ...line, seenBy: seen.by, steps: at < 0 ? [...line.steps, step] : line.steps.toSpliced(at, 0, step) };
}
