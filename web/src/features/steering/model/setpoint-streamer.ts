/**
 * Streams setpoints to one device at 40 Hz while the lease is held and telemetry is fresh: joint targets until they are
 * reached, or a velocity of a frame or the base while an input is held. Only the newest of them is active. Any doubt ends
 * the stream, which never resumes automatically.
 */
import { batch, computed, signal, type ReadonlySignal } from "@preact/signals-core";
import { clamp, radians } from "../../../shared/lib/angles";
import { now } from "../../../shared/lib/clock";
import type { KnownTelemetry } from "../../../shared/mqtt/parse-messages";
import type { Joint, Setpoint } from "../../../shared/mqtt/protocol.generated";
import { restOf, type Velocity, type SteeringMode } from "./steerable-parts";

export const PERIOD_MS = 25;
/** Telemetry older than this is stale: the agent would reject a setpoint that echoes it [ms]. */
export const FRESH_MS = 200;
/** Without fresh telemetry for this long the target is abandoned, to prevent unexpected motion later [ms]. */
export const ABANDON_MS = 1_000;
/** The same for a velocity: the robot's watchdog has stopped it by then, and it must not restart [ms]. */
export const LOST_MS = 400;
/** After release, zero velocity is sent for this long and until the robot rests, so that its watchdog is not needed [ms]. */
export const SETTLE_MS = 400;
const SETTLE_AT_MOST_MS = 1_500;
/** Tolerance of the measured position at the target [rad]. */
const REACHED_RAD = radians(0.2);
/** Tolerance of the commanded position at the target [rad]. */
const COMMANDED_RAD = radians(0.02);
const STILL_RAD_S = 0.005;
/** Without motion for this long before the target, the robot is blocked and the stream ends [ms]. */
export const STUCK_MS = 2_000;

type StreamState = "idle" | "streaming" | "waiting";
export type EndedBecause = "reached" | "stuck" | "let-go" | "stopped" | "hidden" | "lost-sight" | "busy" | "no-connection" | null;

/** Joint name → position [rad]. */
export type Targets = Readonly<Record<string, number>>;

interface StreamerOptions {
  epoch: number;
  joints: readonly Joint[];
  /** Sends one setpoint; rejects without a connection. */
  send: (setpoint: Setpoint) => Promise<void>;
  /** The newest telemetry of the device, if any, with its arrival time on the page's clock [ms]. */
  telemetry: () => Seen | null;
}

interface Seen {
  message: KnownTelemetry;
  receivedAt: number;
}

/** An active velocity, or, after `letGoAt`, the zero velocity that follows it. */
interface Held {
  velocity: Velocity;
  letGoAt: number | null;
}

export class SetpointStreamer {
  readonly #options: StreamerOptions;
  readonly #targets = signal<Targets>({});
  readonly #state = signal<StreamState>("idle");
  readonly #ended = signal<EndedBecause>(null);
  readonly #held = signal<Held | null>(null);
  readonly #timer: ReturnType<typeof setInterval>;
  #sequence = 0;
  #sending = 0;
  #startedAt = 0;
  #movedAt = 0;
  #sentAt = 0;

  readonly targets: ReadonlySignal<Targets> = this.#targets;
  readonly state: ReadonlySignal<StreamState> = this.#state;
  /** Why the last stream ended. */
  readonly ended: ReadonlySignal<EndedBecause> = this.#ended;
  /** The active stream; `null`: none. */
  readonly way = computed<SteeringMode | null>(() => {
    if (this.#state.value === "idle") return null;
    return this.#held.value?.velocity.kind ?? "joints";
  });
  /** Joint targets, if known: a velocity has no target. */
  readonly goal = computed<Targets | null>(() => (this.way.value === "joints" ? this.#targets.value : null));
  /** The active velocity; `null`: none. */
  readonly velocity = computed<Velocity | null>(() => {
    const held = this.#held.value;
    return held?.letGoAt === null ? held.velocity : null;
  });

  constructor(options: StreamerOptions) {
    this.#options = options;
    this.follow();
    this.#timer = setInterval(() => this.tick(), PERIOD_MS);
  }

  /** At rest, targets follow the commanded positions, so that a small step stays small. */
  follow(): void {
    const latest = this.#options.telemetry();
    if (this.way.peek() === "joints" || latest === null) return;
    const next = named(this.#options.joints, latest.message.commanded_rad);
    const known = this.#targets.value;
    if (Object.entries(next).some(([name, position]) => known[name] !== position)) this.#targets.value = next;
  }

  /** Sets a joint's target [rad], clamped to the joint's range. */
  setTarget(name: string, positionRad: number): void {
    const joint = this.#options.joints.find((one) => one.name === name);
    if (joint === undefined || !Number.isFinite(positionRad)) return;
    const at = now();
    const target = clamp(positionRad, joint.lower_rad, joint.upper_rad);
    this.#leaveFor("joints");
    batch(() => {
      // Start from the robot's current position, not from the slider's last value.
      this.follow();
      this.#targets.value = { ...this.#targets.value, [name]: target };
      this.#movedAt = at;
      this.#begin(at);
    });
    this.tick();
  }

  /**
   * Starts or changes a velocity of a frame or the base, until `letGo`. A zero velocity does not start a stream.
   */
  hold(velocity: Velocity): void {
    if (!parts(velocity).every(Number.isFinite)) return;
    if (parts(velocity).every((part) => part === 0)) {
      this.letGo();
      return;
    }
    const at = now();
    this.#leaveFor(velocity.kind);
    batch(() => {
      this.#held.value = { velocity, letGoAt: null };
      this.#begin(at);
    });
    this.tick();
  }

  /** Releases the velocity: sends zero velocity until the robot rests. Joint targets stay. */
  letGo(): void {
    const held = this.#held.value;
    if (held?.letGoAt !== null) return;
    this.#held.value = { velocity: restOf(held.velocity), letGoAt: now() };
    this.#say();
  }

  /** Ends the stream; targets return to the robot's positions. A velocity ends with zero velocity. */
  end(because: EndedBecause): void {
    if (this.#state.value === "idle") return;
    this.letGo();
    batch(() => {
      this.#state.value = "idle";
      this.#ended.value = because;
      this.#held.value = null;
      this.follow();
    });
  }

  dispose(): void {
    clearInterval(this.#timer);
    this.end(null);
  }

  /** One timer step. */
  tick(): void {
    if (this.#state.value === "idle") return;
    const at = now();
    const latest = this.#seen(at);
    if (latest === null) {
      this.#state.value = "waiting";
      if (at - this.#sentAt > this.#patienceMs) this.end("lost-sight");
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

  /** The newest telemetry, if an agent would still accept a setpoint that echoes it. */
  #seen(at: number): Seen | null {
    const latest = this.#options.telemetry();
    return latest === null || at - latest.receivedAt > FRESH_MS ? null : latest;
  }

  get #patienceMs(): number {
    return this.#held.value === null ? ABANDON_MS : LOST_MS;
  }

  #begin(at: number): void {
    if (this.#state.value !== "idle") return;
    this.#startedAt = at;
    this.#sentAt = at;
    this.#state.value = "waiting";
    this.#ended.value = null;
  }

  /** Ends the previous steering mode, so that two modes are never active together. */
  #leaveFor(next: SteeringMode): void {
    const way = this.way.value;
    if (way === next) return;
    if (this.#held.value !== null) {
      this.end("let-go");
    } else if (way === "joints") {
      const latest = this.#options.telemetry();
      // Moving joints stop at their current positions.
      this.#targets.value = named(this.#options.joints, latest?.message.commanded_rad ?? []);
      this.#say();
      this.end(null);
    }
  }

  /** Sends the current setpoint once, even if earlier ones are still in flight. */
  #say(): void {
    const latest = this.#seen(now());
    if (latest !== null) this.#send(latest.message, now());
  }

  #stream(message: KnownTelemetry, at: number): void {
    if (this.#held.value === null ? this.#reached(message, at) : this.#settled(this.#held.value, message, at)) return;
    if (this.#sending > 0) {
      // The previous setpoint is still being sent. Do not queue: the newest target is sent next.
      if (at - this.#sentAt > this.#patienceMs) this.end("no-connection");
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
    const velocity = this.#held.value?.velocity;
    const setpoint: Setpoint = {
      epoch,
      sequence: this.#sequence,
      echo_tick_ms: message.tick_ms,
      sent_ms: at,
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
  #settled({ letGoAt }: Held, message: KnownTelemetry, at: number): boolean {
    if (letGoAt === null || at - letGoAt < SETTLE_MS) return false;
    if (!still(message) && at - letGoAt < SETTLE_AT_MOST_MS) return false;
    this.end("let-go");
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
    const rests = still(message);
    if (!rests) this.#movedAt = at;
    if (rests && at - this.#movedAt > STUCK_MS && at - this.#startedAt > STUCK_MS) {
      // Commanded at the target counts as reached: a servo may deviate by more than the page's tolerance.
      this.end(commanded ? "reached" : "stuck");
      return true;
    }
    return false;
  }
}

function still(message: KnownTelemetry): boolean {
  return message.velocity_rad_s.every((velocity) => Math.abs(velocity) < STILL_RAD_S);
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
