/**
 * Streams what the operator wants of one device while a lease is held, 40 times a second, for as long as the page can
 * see the robot: joint targets until they are reached, a velocity (of a frame or of the base) for as long as it is held.
 * There is one of these at a time, the newest. Whatever is in doubt ends the stream; nothing is sent again by itself
 * afterwards.
 */
import { batch, computed, signal, type ReadonlySignal } from "@preact/signals-core";
import { clamp, radians } from "../../../shared/lib/angles";
import { now } from "../../../shared/lib/clock";
import type { KnownTelemetry } from "../../../shared/mqtt/parse-messages";
import type { Joint, Setpoint } from "../../../shared/mqtt/protocol.generated";
import { restOf, type Velocity, type SteeringMode } from "./steerable-parts";

export const PERIOD_MS = 25;
/** Telemetry older than this is not fresh: the agent would refuse a setpoint that echoes it [ms]. */
export const FRESH_MS = 200;
/** After this long without fresh telemetry the target is given up, so that nothing moves by surprise later [ms]. */
export const ABANDON_MS = 1_000;
/** The same of a velocity: the robot's watchdog has stopped it by then, and it must not start again by itself [ms]. */
export const LOST_MS = 400;
/** A velocity that was let go: rest is sent for so long, and until the robot rests, so that its watchdog need not act [ms]. */
export const SETTLE_MS = 400;
const SETTLE_AT_MOST_MS = 1_500;
/** Measured this close to the target is there [rad]. */
export const REACHED_RAD = radians(0.2);
/** Commanded this close to the target: the agent has nothing left to do [rad]. */
const COMMANDED_RAD = radians(0.02);
const STILL_RAD_S = 0.005;
/** Not there, yet nothing moves for this long: something holds it back, and streaming on would not help [ms]. */
export const STUCK_MS = 2_000;

export type StreamState = "idle" | "streaming" | "waiting";
export type EndedBecause = "reached" | "stuck" | "let-go" | "stopped" | "hidden" | "lost-sight" | "busy" | "no-connection" | null;

/** Joint name → position [rad]. */
export type Targets = Readonly<Record<string, number>>;

export interface StreamerOptions {
  epoch: number;
  joints: readonly Joint[];
  /** Sends one setpoint; rejects when there is no connection. */
  send: (setpoint: Setpoint) => Promise<void>;
  /** The newest telemetry of the device, if any, with when it came on the page's clock [ms]. */
  telemetry: () => Seen | null;
}

interface Seen {
  message: KnownTelemetry;
  receivedAt: number;
}

/** A velocity that is held, or, since `letGoAt`, the rest that follows it. */
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
  /** What is streamed; `null`: nothing. */
  readonly way = computed<SteeringMode | null>(() => {
    if (this.#state.value === "idle") return null;
    return this.#held.value?.velocity.kind ?? "joints";
  });
  /** Where the joints are to go, as far as anybody knows: a velocity leads nowhere in particular. */
  readonly goal = computed<Targets | null>(() => (this.way.value === "joints" ? this.#targets.value : null));
  /** The velocity that is held now; `null`: none. */
  readonly velocity = computed<Velocity | null>(() => {
    const held = this.#held.value;
    return held?.letGoAt === null ? held.velocity : null;
  });

  constructor(options: StreamerOptions) {
    this.#options = options;
    this.follow();
    this.#timer = setInterval(() => this.tick(), PERIOD_MS);
  }

  /** Targets of a device at rest are where it is commanded to be, so that the next small step is a small step. */
  follow(): void {
    const latest = this.#options.telemetry();
    if (this.way.peek() === "joints" || latest === null) return;
    const next = named(this.#options.joints, latest.message.commanded_rad);
    const known = this.#targets.value;
    if (Object.entries(next).some(([name, position]) => known[name] !== position)) this.#targets.value = next;
  }

  /** The operator wants this joint there [rad]; clamped to the joint's range. */
  setTarget(name: string, positionRad: number): void {
    const joint = this.#options.joints.find((one) => one.name === name);
    if (joint === undefined || !Number.isFinite(positionRad)) return;
    const at = now();
    const target = clamp(positionRad, joint.lower_rad, joint.upper_rad);
    this.#leaveFor("joints");
    batch(() => {
      // A first touch starts from where the robot is now, not from where a slider was left.
      this.follow();
      this.#targets.value = { ...this.#targets.value, [name]: target };
      this.#movedAt = at;
      this.#begin(at);
    });
    this.tick();
  }

  /**
   * The operator holds this: a frame or the base moves so until `letGo`. Said again with another velocity, that counts.
   * What is at rest is not held.
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

  /** Nothing is held any more: rest is asked for at once, and until the robot rests. Joint targets stay. */
  letGo(): void {
    const held = this.#held.value;
    if (held?.letGoAt !== null) return;
    this.#held.value = { velocity: restOf(held.velocity), letGoAt: now() };
    this.#say();
  }

  /** End the stream now; targets return to the robot. A velocity ends with rest. */
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

  /** One step; the timer's work. */
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

  /** The newest telemetry, while an agent would take a setpoint that answers it. */
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

  /** Another way of steering begins: what was asked before must not go on beside it. */
  #leaveFor(next: SteeringMode): void {
    const way = this.way.value;
    if (way === next) return;
    if (this.#held.value !== null) {
      this.end("let-go");
    } else if (way === "joints") {
      const latest = this.#options.telemetry();
      // Joints that were on their way stay where they have come to.
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
      // The last one has not left yet. The newest target will go instead of queueing behind it.
      if (at - this.#sentAt > this.#patienceMs) this.end("no-connection");
      return;
    }
    this.#send(message, at);
  }

  #send(message: KnownTelemetry, at: number): void {
    const { epoch } = this.#options;
    // Another page of the same sign-in may have counted on in this lease: an agent takes rising numbers only.
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

  /** Whether what was let go rests. */
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
      // Close enough is there: a servo may droop by more than the page's tolerance.
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
