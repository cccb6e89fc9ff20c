/** A small robot for tests: follows setpoints at a limited speed, brakes without them, latches Stop. */
import type { Description, JointTelemetry, Mode, Setpoint, State, Twin } from "../../src/shared/mqtt/protocol.generated";
import type { Pose } from "../../src/shared/lib/vectors";
import fixture from "../fixtures/ur5.json";

export const description = fixture.description as unknown as Required<Description>;
export const twin = fixture.twin as unknown as Twin;

const STEP_MS = 10;
const SPEED_RAD_S = 1.6;
const HOME: Readonly<Record<string, number>> = {
  shoulder_pan: 0,
  shoulder_lift: -Math.PI / 2,
  elbow: Math.PI / 2,
  wrist_1: -Math.PI / 2,
  wrist_2: -Math.PI / 2,
  wrist_3: 0,
};

export type Publish = (kind: string, message: object, options: { qos: 0 | 1; retain: boolean }) => void;

export class Arm {
  readonly #publish: Publish;
  readonly #timer: ReturnType<typeof setInterval>;
  readonly #position = description.joints.map((joint) => HOME[joint.name] ?? 0);
  #velocity = this.#position.map(() => 0);
  #target = [...this.#position];
  #sequence = 0;
  #tick = 0;
  #setpoint: { sequence: number; sentMs: number; at: number; loopAgeMs: number } | null = null;
  #lastMode: Mode | null = null;
  /** No telemetry, as if the robot had gone quiet. */
  mute = false;
  epoch = 0;
  holder: string | null = null;
  stop: { caller: string; reason: string; at_ms: number } | null = null;
  action: { id: string; kind: string; name: string; progress: number } | null = null;
  /** Every setpoint that came, for assertions. */
  readonly setpoints: Setpoint[] = [];
  /** How many stop messages came. */
  stops = 0;
  /** Hear stops and do nothing, as if they were lost on the way. */
  deaf = false;

  constructor(publish: Publish) {
    this.#publish = publish;
    this.#timer = setInterval(() => this.#step(), STEP_MS);
    publish("desc", description, { qos: 1, retain: true });
    publish("desc/twin", twin, { qos: 1, retain: true });
  }

  get positions(): Readonly<Record<string, number>> {
    return Object.fromEntries(description.joints.map((joint, index) => [joint.name, this.#position[index] ?? NaN]));
  }

  close(): void {
    clearInterval(this.#timer);
  }

  take(setpoint: Setpoint): void {
    this.setpoints.push(setpoint);
    const loopAgeMs = this.#tick - setpoint.echo_tick_ms;
    const fresh = loopAgeMs <= description.max_loop_age_ms;
    if (setpoint.epoch !== this.epoch || setpoint.sequence <= (this.#setpoint?.sequence ?? 0) || !fresh) return;
    if (this.stop !== null || this.action !== null) return;
    this.#setpoint = { sequence: setpoint.sequence, sentMs: setpoint.sent_ms, at: this.#tick, loopAgeMs };
    const { target } = setpoint;
    if (target.kind !== "joints") return;
    description.joints.forEach((joint, index) => {
      this.#target[index] = target.position_rad[joint.name] ?? this.#target[index] ?? 0;
    });
  }

  latch(caller: string, reason: string): void {
    this.stops += 1;
    if (this.deaf || this.stop !== null) return;
    this.stop = { caller, reason, at_ms: Date.now() };
    this.#target = [...this.#position];
  }

  grant(epoch: number, holder: string | null): void {
    if (epoch !== this.epoch) this.#setpoint = null;
    this.epoch = epoch;
    this.holder = holder;
    this.#tellState();
  }

  #step(): void {
    this.#tick += STEP_MS;
    const quiet = this.#setpoint === null || this.#tick - this.#setpoint.at > description.watchdog_ms;
    if (quiet && this.action === null) this.#target = [...this.#position];
    const most = (SPEED_RAD_S * STEP_MS) / 1000;
    this.#velocity = this.#position.map((position, index) => {
      const moved = Math.min(most, Math.max(-most, (this.#target[index] ?? position) - position));
      this.#position[index] = position + moved;
      return moved / (STEP_MS / 1000);
    });
    const moving = this.#velocity.some((velocity) => velocity !== 0);
    if (!this.mute && this.#tick % (moving ? 20 : 50) === 0) this.#tell(quiet);
    if (this.#mode(quiet) !== this.#lastMode) this.#tellState(quiet);
  }

  #mode(quiet: boolean): Mode {
    if (this.stop !== null) return "stopped";
    if (this.action !== null) return "action";
    if (this.holder === null) return "idle";
    return quiet ? "holding" : "streaming";
  }

  #tell(quiet: boolean): void {
    this.#sequence += 1;
    const message: JointTelemetry = {
      tick_ms: this.#tick,
      at_ms: Date.now(),
      sequence: this.#sequence,
      mode: this.#mode(quiet),
      position_rad: [...this.#position],
      velocity_rad_s: [...this.#velocity],
      effort_nm: this.#position.map((position, index) => 40 * Math.cos(position) * 0.4 ** index),
      commanded_rad: [...this.#position],
      frames: description.frames.map((_, index): Pose => [-0.1 * index, -0.109, 0.5, Math.SQRT1_2, Math.SQRT1_2, 0, 0]),
      epoch: this.epoch,
      setpoint_sequence: this.#setpoint?.sequence ?? 0,
      setpoint_sent_ms: this.#setpoint?.sentMs ?? 0,
      loop_age_ms: this.#setpoint?.loopAgeMs ?? 0,
    };
    this.#publish("tele/joints", message, { qos: 0, retain: false });
  }

  #tellState(quiet = true): void {
    this.#lastMode = this.#mode(quiet);
    const state: State = {
      device: description.device,
      at_ms: Date.now(),
      tick_ms: this.#tick,
      mode: this.#lastMode,
      epoch: this.epoch,
      stop: this.stop,
      lease: this.holder === null ? null : { holder: this.holder, epoch: this.epoch, expires_in_ms: 30_000 },
      action: this.action,
    };
    this.#publish("state", state, { qos: 1, retain: true });
  }
}
