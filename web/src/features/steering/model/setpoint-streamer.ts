/**
 * Streams setpoints to one device at 40 Hz while the lease is held and telemetry is recent: joint targets until they are
 * reached, or a velocity of a frame or the base while an input is held. Only the newest of them is active. Missing data ends
 * the stream and the operator's input: only a new input (`begin`) continues. The robot enforces the same by the input's number.
 */
import { batch, computed, signal, type ReadonlySignal } from "@preact/signals-core";
import { clamp, radians } from "../../../shared/lib/angles";
import { now } from "../../../shared/lib/clock";
import type { KnownTelemetry } from "../../../shared/mqtt/parse-messages";
import type { Joint, Setpoint } from "../../../shared/mqtt/protocol.generated";
import { DelayMeter, type Delay } from "./delay-meter";
import { zeroOf, type Velocity, type SteeringMode } from "./steerable-parts";

export const PERIOD_MS = 25;
/** Telemetry older than this is stale: the agent would reject a setpoint that echoes it [ms]. */
export const FRESH_MS = 200;
/** Without recent telemetry for this long the target is abandoned, to prevent unexpected motion later [ms]. */
export const ABANDON_MS = 1_000;
/** The same for a velocity: the robot's watchdog has stopped it by then, and it must not restart [ms]. */
export const LOST_MS = 400;
/** After release, zero velocity is sent for this long and until the robot rests, so that its watchdog is not needed [ms]. */
export const SETTLE_MS = 400;
const MAX_SETTLE_MS = 1_500;
/** Tolerance of the measured position at the target [rad]. */
const REACHED_RAD = radians(0.2);
/** Tolerance of the commanded position at the target [rad]. */
const COMMANDED_RAD = radians(0.02);
const AT_REST_RAD_S = 0.005;
/** The robot's watchdog: without a setpoint for this long, it holds and ends the input [ms]. */
export const WATCHDOG_MS = 300;
/** Without motion for this long before the target, the robot is blocked and the stream ends [ms]. */
export const STUCK_MS = 2_000;

type StreamState = "idle" | "streaming" | "waiting";
export type EndedBecause = "reached" | "paused" | "stuck" | "released" | "stopped" | "hidden" | "no-telemetry" | "busy" | "no-connection" | null;

/** These ends also end the operator's input. */
const ENDS_INPUT: readonly EndedBecause[] = ["paused", "stopped", "hidden", "no-telemetry", "busy", "no-connection"];

/** Joint name → position [rad]. */
export type Targets = Readonly<Record<string, number>>;

interface StreamerOptions {
  epoch: number;
  joints: readonly Joint[];
  /** Sends one setpoint; rejects without a connection. */
  send: (setpoint: Setpoint) => Promise<void>;
  /** The newest telemetry of the device, if any, with its arrival time on the page's clock [ms]. */
  telemetry: () => ReceivedTelemetry | null;
}

interface ReceivedTelemetry {
  message: KnownTelemetry;
  receivedAt: number;
}

/** An active velocity, or, after `releasedAt`, the zero velocity that follows it. */
interface ActiveVelocity {
  velocity: Velocity;
  releasedAt: number | null;
}

export class SetpointStreamer {
  readonly #options: StreamerOptions;
  readonly #targets = signal<Targets>({});
  readonly #state = signal<StreamState>("idle");
  readonly #ended = signal<EndedBecause>(null);
  readonly #active = signal<ActiveVelocity | null>(null);
  readonly #timer: ReturnType<typeof setInterval>;
  readonly #delays = new DelayMeter();
  readonly #warning = signal<Delay | null>(null);
  readonly #pause = signal<Delay | null>(null);
  #input = 0;
  #inputEnded = false;
  #tickedAt = now();
  #sequence = 0;
  #sending = 0;
  #startedAt = 0;
  #movedAt = 0;
  #sentAt = 0;

  readonly targets: ReadonlySignal<Targets> = this.#targets;
  readonly state: ReadonlySignal<StreamState> = this.#state;
  /** Why the last stream ended. */
  readonly ended: ReadonlySignal<EndedBecause> = this.#ended;
  /** The present delay of an active stream, before it causes a pause; `null`: none. */
  readonly warning: ReadonlySignal<Delay | null> = this.#warning;
  /** The measured cause of the pause, if `ended` is "paused". */
  readonly pause: ReadonlySignal<Delay | null> = this.#pause;
  /** The active stream; `null`: none. */
  readonly steeringMode = computed<SteeringMode | null>(() => {
    if (this.#state.value === "idle") return null;
    return this.#active.value?.velocity.kind ?? "joints";
  });
  /** Joint targets, if known: a velocity has no target. */
  readonly goal = computed<Targets | null>(() => (this.steeringMode.value === "joints" ? this.#targets.value : null));
  /** The active velocity; `null`: none. */
  readonly velocity = computed<Velocity | null>(() => {
    const active = this.#active.value;
    return active?.releasedAt === null ? active.velocity : null;
  });

  constructor(options: StreamerOptions) {
    this.#options = options;
    this.follow();
    this.#timer = setInterval(() => this.tick(), PERIOD_MS);
  }

  /** At rest, targets follow the commanded positions, so that a small step stays small. */
  follow(): void {
    const latest = this.#options.telemetry();
    if (latest !== null) this.#delays.receive(latest.message, latest.receivedAt);
    if (this.steeringMode.peek() === "joints" || latest === null) return;
    const next = named(this.#options.joints, latest.message.commanded_rad);
    const current = this.#targets.value;
    if (Object.entries(next).some(([name, position]) => current[name] !== position)) this.#targets.value = next;
  }

  /** Starts a new input: the operator pressed a pointer, key or gamepad. */
  begin(): void {
    this.#input = Math.max(this.#input, this.#reportedEnd) + 1;
    this.#inputEnded = false;
    this.#tickedAt = now();
  }

  /** Sets a joint's target [rad], clamped to the joint's range. Without effect after the end of the input. */
  setTarget(name: string, positionRad: number): void {
    const joint = this.#options.joints.find((one) => one.name === name);
    if (joint === undefined || !Number.isFinite(positionRad)) return;
    const at = now();
    if (!this.#continues) return;
    const target = clamp(positionRad, joint.lower_rad, joint.upper_rad);
    this.#endOtherMode("joints");
    batch(() => {
      // Start at the robot's current position, not at the slider's last value.
      this.follow();
      this.#targets.value = { ...this.#targets.value, [name]: target };
      this.#movedAt = at;
      this.#startStream(at);
    });
    this.tick();
  }

  /**
   * Starts or changes a velocity of a frame or the base, until `release`. A zero velocity does not start a stream.
   */
  setVelocity(velocity: Velocity): void {
    if (!parts(velocity).every(Number.isFinite)) return;
    if (parts(velocity).every((part) => part === 0)) {
      this.release();
      return;
    }
    const at = now();
    if (!this.#continues) return;
    this.#endOtherMode(velocity.kind);
    batch(() => {
      this.#active.value = { velocity, releasedAt: null };
      this.#startStream(at);
    });
    this.tick();
  }

  /** Releases the velocity: sends zero velocity until the robot rests. Joint targets stay. */
  release(): void {
    const active = this.#active.value;
    if (active?.releasedAt !== null) return;
    this.#active.value = { velocity: zeroOf(active.velocity), releasedAt: now() };
    this.#sendNow();
  }

  /** Ends the stream; targets return to the robot's positions. A velocity ends with zero velocity. */
  end(because: EndedBecause): void {
    this.#inputEnded ||= ENDS_INPUT.includes(because);
    if (this.#state.value === "idle") return;
    if (because !== "paused") this.release();
    batch(() => {
      this.#warning.value = null;
      this.#state.value = "idle";
      this.#ended.value = because;
      this.#active.value = null;
      this.follow();
    });
  }

  dispose(): void {
    clearInterval(this.#timer);
    this.end(null);
  }

  /** One timer step. */
  tick(): void {
    const at = now();
    const gap = at - this.#tickedAt;
    this.#tickedAt = at;
    this.#delays.tick(at);
    if (this.#state.value === "idle") return;
    // A page that was busy for too long ends its input, also if the robot rested meanwhile.
    if (gap > WATCHDOG_MS || this.#input <= this.#reportedEnd) {
      this.#endByPause(at);
      return;
    }
    this.#warn(at);
    const latest = this.#freshTelemetry(at);
    if (latest === null) {
      this.#state.value = "waiting";
      if (at - this.#sentAt > this.#timeoutMs) this.end("no-telemetry");
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

  /** The highest input that the robot has ended in this lease. */
  get #reportedEnd(): number {
    const message = this.#options.telemetry()?.message;
    return message?.epoch === this.#options.epoch ? message.ended_input : 0;
  }

  /** Whether the current input still applies. */
  get #continues(): boolean {
    if (this.#input === 0) this.begin();
    return !this.#inputEnded;
  }

  #endByPause(at: number): void {
    this.#pause.value = this.#delays.longest(at);
    this.end("paused");
  }

  #warn(at: number): void {
    const next = this.#delays.longest(at);
    const current = this.#warning.peek();
    if (next?.cause !== current?.cause || next?.ms !== current?.ms) this.#warning.value = next;
  }

  /** The newest telemetry, if an agent would still accept a setpoint that echoes it. */
  #freshTelemetry(at: number): ReceivedTelemetry | null {
    const latest = this.#options.telemetry();
    return latest === null || at - latest.receivedAt > FRESH_MS ? null : latest;
  }

  get #timeoutMs(): number {
    return this.#active.value === null ? ABANDON_MS : LOST_MS;
  }

  #startStream(at: number): void {
    if (this.#state.value !== "idle") return;
    this.#startedAt = at;
    this.#sentAt = at;
    this.#state.value = "waiting";
    this.#ended.value = null;
  }

  /** Ends the previous steering mode, so that two modes are never active together. */
  #endOtherMode(next: SteeringMode): void {
    const steeringMode = this.steeringMode.value;
    if (steeringMode === next) return;
    if (this.#active.value !== null) {
      this.end("released");
    } else if (steeringMode === "joints") {
      const latest = this.#options.telemetry();
      // Moving joints stop at their current positions.
      this.#targets.value = named(this.#options.joints, latest?.message.commanded_rad ?? []);
      this.#sendNow();
      this.end(null);
    }
  }

  /** Sends the current setpoint once, even if earlier ones are still in flight. */
  #sendNow(): void {
    const latest = this.#freshTelemetry(now());
    if (latest !== null) this.#send(latest.message, now());
  }

  #stream(message: KnownTelemetry, at: number): void {
    if (this.#active.value === null ? this.#reached(message, at) : this.#settled(this.#active.value, message, at)) return;
    if (this.#sending > 0) {
      // The previous setpoint is still being sent. Do not queue: the newest target is sent next.
      this.#delays.wait(this.#sentAt, at);
      if (at - this.#sentAt > this.#timeoutMs) this.end("no-connection");
      return;
    }
    this.#send(message, at);
  }

  #send(message: KnownTelemetry, at: number): void {
    const { epoch } = this.#options;
    // Another page of this session may have used higher numbers in this lease: an agent requires increasing ones.
    if (message.epoch === epoch) this.#sequence = Math.max(this.#sequence, message.setpoint_sequence);
    this.#sequence += 1;
    this.#sending += 1;
    const velocity = this.#active.value?.velocity;
    const setpoint: Setpoint = {
      epoch,
      sequence: this.#sequence,
      echo_tick_ms: message.tick_ms,
      sent_ms: at,
      input: this.#input,
      target: velocity ?? { kind: "joints", position_rad: { ...this.#targets.value } },
    };
    this.#options.send(setpoint).then(
      () => {
        this.#sending -= 1;
        this.#sentAt = at;
        if (this.#state.value === "waiting") this.#state.value = "streaming";
      },
      () => {
        this.#sending -= 1;
        if (this.#state.value === "idle") return;
        this.#state.value = "waiting";
        if (velocity !== undefined || at - this.#sentAt > ABANDON_MS) this.end("no-connection");
      },
    );
  }

  /** Whether the robot rests after a release. */
  #settled({ releasedAt }: ActiveVelocity, message: KnownTelemetry, at: number): boolean {
    if (releasedAt === null || at - releasedAt < SETTLE_MS) return false;
    if (!isAtRest(message) && at - releasedAt < MAX_SETTLE_MS) return false;
    this.end("released");
    return true;
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
    const atRest = isAtRest(message);
    if (!atRest) this.#movedAt = at;
    if (atRest && at - this.#movedAt > STUCK_MS && at - this.#startedAt > STUCK_MS) {
      // Commanded at the target counts as reached: a servo may deviate by more than the page's tolerance.
      this.end(commanded ? "reached" : "stuck");
      return true;
    }
    return false;
  }
}

function isAtRest(message: KnownTelemetry): boolean {
  return message.velocity_rad_s.every((velocity) => Math.abs(velocity) < AT_REST_RAD_S);
}

function named(joints: readonly Joint[], positions: readonly number[]): Targets {
  const found: Record<string, number> = {};
  for (const [index, joint] of joints.entries()) {
    const position = positions[index];
    if (position !== undefined) found[joint.name] = position;
  }
  return found;
}

function parts(velocity: Velocity): number[] {
  if (velocity.kind === "drive") return [velocity.forward_m_s ?? 0, velocity.left_m_s ?? 0, velocity.turn_rad_s ?? 0];
  return [...(velocity.linear_m_s ?? []), ...(velocity.angular_rad_s ?? [])];
}
