/**
 * Streams the operator's targets to one device while a lease is held: the newest target, 40 times a second, for as
 * long as the robot has not reached it and the page can see the robot. Whatever is in doubt ends the stream; nothing
 * is sent again by itself afterwards.
 */
import { batch, signal, type ReadonlySignal } from "@preact/signals-core";
import { clamp, radians } from "./angles";
import { now } from "./clock";
import type { KnownTelemetry } from "./messages";
import type { Joint, Setpoint } from "./protocol";

export const PERIOD_MS = 25;
/** Telemetry older than this is not fresh: the agent would refuse a setpoint that echoes it [ms]. */
export const FRESH_MS = 200;
/** After this long without fresh telemetry the target is given up, so that nothing moves by surprise later [ms]. */
export const ABANDON_MS = 1_000;
/** Measured this close to the target is there [rad]. */
export const REACHED_RAD = radians(0.2);
/** Commanded this close to the target: the agent has nothing left to do [rad]. */
const COMMANDED_RAD = radians(0.02);
const STILL_RAD_S = 0.005;
/** Not there, yet nothing moves for this long: something holds it back, and streaming on would not help [ms]. */
export const STUCK_MS = 2_000;

export type StreamState = "idle" | "streaming" | "waiting";
export type EndedBecause = "reached" | "stuck" | "stopped" | "hidden" | "lost-sight" | "busy" | "no-connection" | null;

/** Joint name → position [rad]. */
export type Targets = Readonly<Record<string, number>>;

export interface StreamerOptions {
  epoch: number;
  joints: readonly Joint[];
  /** Sends one setpoint; rejects when there is no connection. */
  send: (setpoint: Setpoint) => Promise<void>;
  /** The newest telemetry of the device, if any, with when it came on the page's clock [ms]. */
  telemetry: () => { message: KnownTelemetry; receivedAt: number } | null;
}

export class SetpointStreamer {
  readonly #options: StreamerOptions;
  readonly #targets = signal<Targets>({});
  readonly #state = signal<StreamState>("idle");
  readonly #ended = signal<EndedBecause>(null);
  readonly #timer: ReturnType<typeof setInterval>;
  #sequence = 0;
  #sending = false;
  #startedAt = 0;
  #movedAt = 0;
  #sentAt = 0;

  readonly targets: ReadonlySignal<Targets> = this.#targets;
  readonly state: ReadonlySignal<StreamState> = this.#state;
  /** Why the last stream ended. */
  readonly ended: ReadonlySignal<EndedBecause> = this.#ended;

  constructor(options: StreamerOptions) {
    this.#options = options;
    this.follow();
    this.#timer = setInterval(() => this.tick(), PERIOD_MS);
  }

  /** Targets of a device at rest are where it is commanded to be, so that the next small step is a small step. */
  follow(): void {
    const latest = this.#options.telemetry();
    if (this.#state.value !== "idle" || latest === null) return;
    const commanded = latest.message.commanded_rad;
    const next: Record<string, number> = {};
    for (const [index, joint] of this.#options.joints.entries()) {
      const position = commanded[index];
      if (position !== undefined) next[joint.name] = position;
    }
    const known = this.#targets.value;
    if (Object.entries(next).some(([name, position]) => known[name] !== position)) this.#targets.value = next;
  }

  /** The operator wants this joint there [rad]; clamped to the joint's range. */
  setTarget(name: string, positionRad: number): void {
    const joint = this.#options.joints.find((one) => one.name === name);
    if (joint === undefined || !Number.isFinite(positionRad)) return;
    const at = now();
    const target = clamp(positionRad, joint.lower_rad, joint.upper_rad);
    batch(() => {
      // A first touch starts from where the robot is now, not from where a slider was left.
      this.follow();
      this.#targets.value = { ...this.#targets.value, [name]: target };
      this.#movedAt = at;
      if (this.#state.value === "idle") {
        this.#startedAt = at;
        this.#sentAt = at;
        this.#state.value = "waiting";
        this.#ended.value = null;
      }
    });
    this.tick();
  }

  /** End the stream now; targets return to the robot. */
  end(because: EndedBecause): void {
    if (this.#state.value === "idle") return;
    batch(() => {
      this.#state.value = "idle";
      this.#ended.value = because;
      this.follow();
    });
  }

  dispose(): void {
    clearInterval(this.#timer);
    this.end(null);
  }

  /** One step; the timer's work. */
  tick(): void {
    if (this.#state.value === "idle") return;
    const at = now();
    const latest = this.#options.telemetry();
    if (latest === null || at - latest.receivedAt > FRESH_MS) {
      this.#state.value = "waiting";
      if (at - this.#sentAt > ABANDON_MS) this.end("lost-sight");
      return;
    }
    const { message } = latest;
    if (message.mode === "stopped" || message.mode === "fault") {
      this.end("stopped");
    } else if (message.mode === "action") {
      this.end("busy");
    } else {
      this.#stream(message, at);
    }
  }

  #stream(message: KnownTelemetry, at: number): void {
    if (this.#reached(message, at)) return;
    if (this.#sending) {
      // The last one has not left yet. The newest target will go instead of queueing behind it.
      if (at - this.#sentAt > ABANDON_MS) this.end("no-connection");
      return;
    }
    this.#send(message, at);
  }

  #send(message: KnownTelemetry, at: number): void {
    const { epoch } = this.#options;
    // Another page of the same sign-in may have counted on in this lease: an agent takes rising numbers only.
    if (message.epoch === epoch) this.#sequence = Math.max(this.#sequence, message.setpoint_sequence);
    this.#sequence += 1;
    this.#sending = true;
    const setpoint: Setpoint = {
      epoch,
      sequence: this.#sequence,
      echo_tick_ms: message.tick_ms,
      sent_ms: at,
      target: { kind: "joints", position_rad: { ...this.#targets.value } },
    };
    this.#options.send(setpoint).then(
      () => {
        this.#sending = false;
        this.#sentAt = at;
        if (this.#state.value === "waiting") this.#state.value = "streaming";
      },
      () => {
        this.#sending = false;
        if (this.#state.value === "idle") return;
        this.#state.value = "waiting";
        if (at - this.#sentAt > ABANDON_MS) this.end("no-connection");
      },
    );
  }

  #reached(message: KnownTelemetry, at: number): boolean {
    const targets = this.#options.joints.map((joint) => this.#targets.value[joint.name] ?? NaN);
    const near = (positions: readonly number[], withinRad: number): boolean =>
      targets.every((target, index) => Math.abs((positions[index] ?? NaN) - target) < withinRad);
    const measured = near(message.position_rad, REACHED_RAD);
    const commanded = near(message.commanded_rad, COMMANDED_RAD);
    if (measured && commanded) {
      this.end("reached");
      return true;
    }
    const still = message.velocity_rad_s.every((velocity) => Math.abs(velocity) < STILL_RAD_S);
    if (!still) this.#movedAt = at;
    if (still && at - this.#movedAt > STUCK_MS && at - this.#startedAt > STUCK_MS) {
      // Close enough is there: a servo may droop by more than the page's tolerance.
      this.end(commanded ? "reached" : "stuck");
      return true;
    }
    return false;
  }
}
