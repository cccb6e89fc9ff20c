import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";
import type { KnownTelemetry } from "../../../src/shared/mqtt/parse-messages";
import type { DriveTarget, JogTarget, Joint, Mode, Setpoint } from "../../../src/shared/mqtt/protocol.generated";
import { ABANDON_MS, FRESH_MS, LOST_MS, PERIOD_MS, SETTLE_MS, SetpointStreamer, STUCK_MS } from "../../../src/features/steering/model/setpoint-streamer";

const joint = (name: string): Joint => ({
  name,
  label: name,
  lower_rad: -1,
  upper_rad: 2,
  max_velocity_rad_s: 1,
  max_acceleration_rad_s2: 1,
  max_jerk_rad_s3: 1,
  max_effort_nm: 1,
});

function message(position: readonly number[], rest: Partial<KnownTelemetry> = {}): KnownTelemetry {
  return {
    tick_ms: 0,
    at_ms: 0,
    sequence: 0,
    mode: "holding",
    position_rad: [...position],
    velocity_rad_s: position.map(() => 0),
    effort_nm: position.map(() => 0),
    commanded_rad: [...position],
    frames: [],
    epoch: 7,
    setpoint_sequence: 0,
    setpoint_sent_ms: 0,
    loop_age_ms: 0,
    limited: [],
    ...rest,
  };
}

/** A robot that publishes telemetry every 20 ms and moves to its setpoint at 1 rad/s, unless `held`. */
class Bench {
  readonly sent: Setpoint[] = [];
  latest: { message: KnownTelemetry; receivedAt: number } | null = null;
  position = [0.5, 0.25];
  mode: Mode = "holding";
  held = false;
  mute = false;
  connected = true;
  sequence = 0;
  tick = 5_000;
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
    this.latest = {
      message: message(this.position, {
        tick_ms: this.tick,
        mode: this.mode,
        velocity_rad_s: moved.map((step) => step / 0.02),
        setpoint_sequence: Math.max(this.sequence, this.sent.at(-1)?.sequence ?? 0),
      }),
      receivedAt: performance.now(),
    };
  }

  /** The joint positions [rad] that were asked for last. */
  newest(): Record<string, number> | undefined {
    const target = this.sent.at(-1)?.target;
    return target?.kind === "joints" ? target.position_rad : undefined;
  }

  async run(ms: number): Promise<void> {
    for (let passed = 0; passed < ms; passed += 20) {
      await vi.advanceTimersByTimeAsync(20);
      this.tick += 20;
      if (this.mute) continue;
      const target = this.newest();
      const moved = this.position.map((position, index) => {
        const wanted = target?.[index === 0 ? "a" : "b"] ?? position;
        const streaming = this.streamer.state.value !== "idle";
        return this.held || !streaming ? 0 : Math.max(-0.02, Math.min(0.02, wanted - position));
      });
      this.position = this.position.map((position, index) => position + (moved[index] ?? 0));
      this.measure(moved);
      this.streamer.follow();
    }
  }
}

let bench: Bench;

beforeEach(() => {
  vi.useFakeTimers();
  bench = new Bench();
});

afterEach(() => {
  bench.streamer.dispose();
  vi.useRealTimers();
});

describe("a stream of setpoints", () => {
  it("starts with targets where the robot is, and sends nothing by itself", async () => {
    expect(bench.streamer.targets.value).toEqual({ a: 0.5, b: 0.25 });
    await bench.run(1_000);
    expect(bench.sent).toEqual([]);
  });

  it("counts from one, names every joint, and echoes the newest telemetry", async () => {
    bench.streamer.setTarget("a", 1);
    await bench.run(100);
    expect(bench.sent[0]).toEqual({
      epoch: 7,
      sequence: 1,
      echo_tick_ms: 5_000,
      sent_ms: expect.any(Number) as number,
      target: { kind: "joints", position_rad: { a: 1, b: 0.25 } },
    });
    expect(bench.sent.map((setpoint) => setpoint.sequence)).toEqual(bench.sent.map((_, index) => index + 1));
    expect(bench.sent.at(-1)?.echo_tick_ms).toBeGreaterThan(5_000);
  });

  it("goes at 30 to 50 Hz until the robot is there, then ends", async () => {
    bench.streamer.setTarget("a", 1);
    await bench.run(400);
    expect(bench.sent.length).toBeGreaterThanOrEqual(400 / 33 - 1);
    expect(bench.sent.length).toBeLessThanOrEqual(400 / 20);
    await bench.run(400);
    expect(bench.streamer.state.value).toBe("idle");
    expect(bench.streamer.ended.value).toBe("reached");
    const count = bench.sent.length;
    await bench.run(500);
    expect(bench.sent).toHaveLength(count);
  });

  it("carries the newest target", async () => {
    bench.streamer.setTarget("a", 1);
    bench.streamer.setTarget("a", 0.9);
    bench.streamer.setTarget("b", 0.5);
    await bench.run(60);
    expect(bench.newest()).toEqual({ a: 0.9, b: 0.5 });
  });

  it("keeps targets inside the joint's range and refuses what is no number", () => {
    bench.streamer.setTarget("a", 99);
    expect(bench.streamer.targets.value["a"]).toBe(2);
    bench.streamer.setTarget("a", NaN);
    bench.streamer.setTarget("unknown", 1);
    expect(bench.streamer.targets.value).toEqual({ a: 2, b: 0.25 });
  });

  it("sends nothing to a robot it cannot see, and gives the target up for good", async () => {
    bench.streamer.setTarget("a", 1.9);
    await bench.run(100);
    bench.mute = true;
    await bench.run(FRESH_MS + 3 * PERIOD_MS);
    expect(bench.streamer.state.value).toBe("waiting");
    const count = bench.sent.length;
    await bench.run(ABANDON_MS + 100);
    expect(bench.streamer.ended.value).toBe("lost-sight");
    bench.mute = false;
    await bench.run(500);
    expect(bench.sent).toHaveLength(count);
    expect(bench.streamer.targets.value["a"]).toBeCloseTo(bench.position[0] ?? NaN);
  });

  it("goes on after a short gap", async () => {
    bench.streamer.setTarget("a", 1.5);
    await bench.run(100);
    bench.mute = true;
    await bench.run(400);
    bench.mute = false;
    await bench.run(1_500);
    expect(bench.streamer.ended.value).toBe("reached");
  });

  it.each<[Mode, string]>([
    ["stopped", "stopped"],
    ["fault", "stopped"],
    ["action", "busy"],
  ])("ends when the robot is in mode %s", async (mode, because) => {
    bench.streamer.setTarget("a", 1.9);
    await bench.run(60);
    bench.mode = mode;
    await bench.run(60);
    const count = bench.sent.length;
    await bench.run(300);
    expect(bench.streamer.ended.value).toBe(because);
    expect(bench.sent).toHaveLength(count);
  });

  it("ends when the page hides, and starts again only by hand", async () => {
    bench.streamer.setTarget("a", 1.9);
    await bench.run(60);
    bench.streamer.end("hidden");
    const count = bench.sent.length;
    await bench.run(300);
    expect(bench.sent).toHaveLength(count);
    bench.streamer.setTarget("b", 0.3);
    // The other joint is not sent on to where it was going before.
    expect(bench.streamer.targets.value["a"]).toBeCloseTo(bench.position[0] ?? NaN);
  });

  it("gives up without a connection", async () => {
    bench.connected = false;
    bench.streamer.setTarget("a", 1);
    await bench.run(ABANDON_MS + 200);
    expect(bench.streamer.ended.value).toBe("no-connection");
    bench.connected = true;
    await bench.run(300);
    expect(bench.sent).toEqual([]);
  });

  it("gives up when something holds the robot back", async () => {
    bench.held = true;
    bench.streamer.setTarget("a", 1);
    await bench.run(STUCK_MS + 200);
    expect(bench.streamer.ended.value).toBe("stuck");
  });

  it("follows a robot that others move, so that the next touch starts where it is", async () => {
    bench.position = [1.25, -0.5];
    await bench.run(40);
    expect(bench.streamer.targets.value).toEqual({ a: 1.25, b: -0.5 });
  });

  it("counts on from what the robot has taken in this lease, after a reload of the page", async () => {
    bench.sequence = 40;
    await bench.run(20);
    bench.streamer.setTarget("a", 1);
    await bench.run(40);
    expect(bench.sent[0]?.sequence).toBe(41);
  });
});

const up: JogTarget = { kind: "jog", linear_m_s: [0, 0, 0.05], angular_rad_s: [0, 0, 0], frame: "tool", tool: false };
const ahead: DriveTarget = { kind: "drive", forward_m_s: 0.2, left_m_s: 0, turn_rad_s: 0 };
const standing: DriveTarget = { kind: "drive", forward_m_s: 0, left_m_s: 0, turn_rad_s: 0 };

describe("a velocity", () => {
  const kinds = (): (string | undefined)[] => bench.sent.map(({ target }) => target.kind);

  it("is sent for as long as it is held, and then rest", async () => {
    bench.streamer.hold(up);
    expect(bench.sent).toHaveLength(1);
    await bench.run(1_000);
    expect(bench.sent.length).toBeGreaterThan(25);
    expect(new Set(bench.sent.map(({ target }) => JSON.stringify(target)))).toEqual(new Set([JSON.stringify(up)]));
    expect(bench.streamer.way.value).toBe("jog");
    expect(bench.streamer.velocity.value).toEqual(up);

    const before = bench.sent.length;
    bench.streamer.letGo();
    // At once, not with the next step.
    expect(bench.sent).toHaveLength(before + 1);
    expect(bench.sent.at(-1)?.target).toEqual({ ...up, linear_m_s: [0, 0, 0] });
    expect(bench.streamer.velocity.value).toBeNull();
    await bench.run(SETTLE_MS + 100);
    expect(bench.sent.slice(before).every(({ target }) => target.kind === "jog" && target.linear_m_s?.[2] === 0)).toBe(true);
    expect(bench.streamer.state.value).toBe("idle");
    expect(bench.streamer.ended.value).toBe("let-go");
    const count = bench.sent.length;
    await bench.run(500);
    expect(bench.sent).toHaveLength(count);
  });

  it("changes while it is held, and ends when it is changed to rest", async () => {
    bench.streamer.hold(ahead);
    await bench.run(60);
    bench.streamer.hold({ ...ahead, turn_rad_s: 0.5 });
    await bench.run(60);
    expect(bench.sent.at(-1)?.target).toEqual({ ...ahead, turn_rad_s: 0.5 });
    bench.streamer.hold(standing);
    expect(bench.sent.at(-1)?.target).toEqual(standing);
    expect(bench.streamer.velocity.value).toBeNull();
  });

  it("that is none, or no number, sends nothing", async () => {
    bench.streamer.hold(standing);
    bench.streamer.hold({ ...ahead, forward_m_s: NaN });
    await bench.run(100);
    expect(bench.sent).toEqual([]);
  });

  it.each(["hidden", "stopped", null] as const)("ends with rest when the stream ends (%s)", async (because) => {
    bench.streamer.hold(ahead);
    await bench.run(100);
    bench.streamer.end(because);
    expect(bench.sent.at(-1)?.target).toEqual(standing);
    const count = bench.sent.length;
    await bench.run(500);
    expect(bench.sent).toHaveLength(count);
    expect(bench.streamer.ended.value).toBe(because);
  });

  it("does not come back by itself when the robot was out of sight for longer than its watchdog waits", async () => {
    bench.streamer.hold(ahead);
    await bench.run(100);
    bench.mute = true;
    await bench.run(FRESH_MS + LOST_MS + 100);
    expect(bench.streamer.ended.value).toBe("lost-sight");
    const count = bench.sent.length;
    bench.mute = false;
    await bench.run(500);
    expect(bench.sent).toHaveLength(count);
  });

  it("ends at the first setpoint that cannot be sent", async () => {
    bench.streamer.hold(ahead);
    await bench.run(100);
    bench.connected = false;
    await bench.run(60);
    expect(bench.streamer.ended.value).toBe("no-connection");
    bench.connected = true;
    const count = bench.sent.length;
    await bench.run(500);
    expect(bench.sent).toHaveLength(count);
  });

  it("takes the place of joint targets, which stay where they have come to", async () => {
    bench.streamer.setTarget("a", 2);
    await bench.run(200);
    const there = bench.position[0];
    bench.streamer.hold(ahead);
    // The robot would go on to the target as long as anything is streamed.
    expect(bench.newest()?.["a"]).toBeCloseTo(there ?? NaN);
    await bench.run(100);
    const from = kinds().indexOf("drive");
    expect(new Set(kinds().slice(from))).toEqual(new Set(["drive"]));
    expect(bench.streamer.goal.value).toBeNull();
  });

  it("is replaced by joint targets, and by another kind, and rests before either", async () => {
    bench.streamer.hold(up);
    await bench.run(60);
    bench.streamer.hold(ahead);
    expect(bench.sent.at(-1)?.target).toEqual({ ...up, linear_m_s: [0, 0, 0] });
    await bench.run(60);
    expect(bench.sent.at(-1)?.target).toEqual(ahead);
    bench.streamer.setTarget("a", 2);
    expect(bench.sent.at(-1)?.target).toEqual(standing);
    await bench.run(60);
    expect(bench.newest()).toEqual({ a: 2, b: 0.25 });
    bench.streamer.letGo(); // what is held no more ends nothing
    await bench.run(60);
    expect(bench.streamer.way.value).toBe("joints");
  });

  it("lets targets follow the robot meanwhile", async () => {
    bench.streamer.hold(up);
    bench.position = [1.25, -0.5];
    await bench.run(40);
    expect(bench.streamer.targets.value).toEqual({ a: 1.25, b: -0.5 });
    expect(bench.streamer.goal.value).toBeNull();
  });
});
