import { vi } from "vitest";
import { readTelemetry, type KnownTelemetry } from "../../src/shared/mqtt/parse-messages";
import type { Joint, Mode, Setpoint } from "../../src/shared/mqtt/protocol.generated";
import { SetpointStreamer } from "../../src/features/steering/model/setpoint-streamer";
import { bytes, telemetry } from "./messages";

const LIMITS = { max_velocity_rad_s: 1, max_acceleration_rad_s2: 1, max_jerk_rad_s3: 1, max_effort_nm: 1 };
const joint = (name: string): Joint => ({ name, label: name, lower_rad: -1, upper_rad: 2, ...LIMITS });

/** A robot that publishes telemetry every 20 ms and moves to its setpoint at 1 rad/s, unless `blocked`. */
export class SimulatedRobot {
  readonly sent: Setpoint[] = [];
  latest: { message: KnownTelemetry; receivedAt: number } | null = null;
  position = [0.5, 0.25];
  mode: Mode = "holding";
  blocked = false;
  silent = false;
  connected = true;
  sequence = 0;
  endedInput = 0;
  readonly streamer: SetpointStreamer;

  constructor() {
    this.measure();
    this.streamer = new SetpointStreamer({
      epoch: 7,
      joints: [joint("a"), joint("b")],
      telemetry: () => this.latest,
      send: (setpoint) => {
        if (!this.connected) return Promise.reject(new Error("no connection"));
        this.sent.push(setpoint);
        return Promise.resolve();
      },
    });
  }

  measure(moved: readonly number[] = [0, 0]): void {
    const message = telemetry({
      epoch: 7,
      mode: this.mode,
      position_rad: this.position,
      commanded_rad: this.position,
      velocity_rad_s: moved.map((step) => step / 0.02),
      effort_nm: [0, 0],
      setpoint_sequence: Math.max(this.sequence, this.sent.at(-1)?.sequence ?? 0),
      ended_input: this.endedInput,
    });
    this.latest = { message: readTelemetry(bytes(message)), receivedAt: performance.now() };
  }

  /** The joint positions [rad] of the newest setpoint. */
  newest(): Record<string, number> | undefined {
    const target = this.sent.at(-1)?.target;
    return target?.kind === "joints" ? target.position_rad : undefined;
  }

  async run(ms: number): Promise<void> {
    for (let passed = 0; passed < ms; passed += 20) {
      await vi.advanceTimersByTimeAsync(20);
      if (this.silent) continue;
      const still = this.blocked || this.streamer.state.value === "idle";
      const moved = this.position.map((position, index) => {
        const target = this.newest()?.[index === 0 ? "a" : "b"] ?? position;
        return still ? 0 : Math.max(-0.02, Math.min(0.02, target - position));
      });
      this.position = this.position.map((position, index) => position + (moved[index] ?? 0));
      this.measure(moved);
      this.streamer.follow();
    }
  }
}
