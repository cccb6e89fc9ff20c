import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";
import type { DriveTarget, JogTarget, Mode, Setpoint } from "../../../src/shared/mqtt/protocol.generated";
import { ABANDON_MS, FRESH_MS, LOST_MS, PERIOD_MS, SETTLE_MS, SetpointStreamer, STUCK_MS, WATCHDOG_MS } from "../../../src/features/steering/model/setpoint-streamer";
import { SimulatedRobot } from "../../support/simulated-robot";

let robot: SimulatedRobot;
let streamer: SetpointStreamer;

beforeEach(() => {
  vi.useFakeTimers();
  robot = new SimulatedRobot();
  ({ streamer } = robot);
});

afterEach(() => {
  streamer.dispose();
  vi.useRealTimers();
});

async function expectNothingMoreSent(): Promise<void> {
  const count = robot.sent.length;
  await robot.run(500);
  expect(robot.sent).toHaveLength(count);
}

describe("a stream of joint targets", () => {
  it("starts at the robot's positions, and sends nothing without input", async () => {
    expect(streamer.targets.value).toEqual({ a: 0.5, b: 0.25 });
    await robot.run(1_000);
    expect(robot.sent).toEqual([]);
  });

  it("contains every joint with its newest target, counts from one, and echoes the newest telemetry", async () => {
    const echo = robot.latest?.message.tick_ms ?? NaN;
    streamer.setTarget("a", 1);
    streamer.setTarget("a", 0.9);
    await robot.run(100);
    const target = { kind: "joints", position_rad: { a: 1, b: 0.25 } };
    expect(robot.sent[0]).toEqual({ epoch: 7, sequence: 1, echo_tick_ms: echo, sent_ms: expect.any(Number) as number, input: 1, target });
    expect(robot.newest()).toEqual({ a: 0.9, b: 0.25 });
    expect(robot.sent.map(({ sequence }) => sequence)).toEqual(robot.sent.map((_, index) => index + 1));
    expect(robot.sent.at(-1)?.echo_tick_ms).toBeGreaterThan(echo);
  });

  it("continues the numbers that the robot accepted in this lease, after a reload of the page", async () => {
    robot.sequence = 40;
    await robot.run(20);
    streamer.setTarget("a", 1);
    expect(robot.sent[0]?.sequence).toBe(41);
  });

  it("runs at 30 to 50 Hz until the target is reached", async () => {
    streamer.setTarget("a", 1);
    await robot.run(400);
    expect(robot.sent.length).toBeGreaterThanOrEqual(400 / 33 - 1);
    expect(robot.sent.length).toBeLessThanOrEqual(400 / 20);
    await robot.run(400);
    expect([streamer.state.value, streamer.ended.value]).toEqual(["idle", "reached"]);
    await expectNothingMoreSent();
  });

  it("clamps targets to the joint's range and ignores invalid ones", () => {
    streamer.setTarget("a", 99);
    streamer.setTarget("a", NaN);
    streamer.setTarget("unknown", 1);
    expect(streamer.targets.value).toEqual({ a: 2, b: 0.25 });
  });

  it("continues after a short gap in telemetry, and abandons the target after a long one", async () => {
    streamer.setTarget("a", 1.9);
    await robot.run(100);
    robot.silent = true;
    await robot.run(FRESH_MS + 3 * PERIOD_MS);
    expect(streamer.state.value).toBe("waiting");
    robot.silent = false;
    await robot.run(100);
    expect(streamer.state.value).toBe("streaming");
    robot.silent = true;
    await robot.run(FRESH_MS + ABANDON_MS + 100);
    expect(streamer.ended.value).toBe("no-telemetry");
    robot.silent = false;
    await expectNothingMoreSent();
    expect(streamer.targets.value["a"]).toBeCloseTo(robot.position[0] ?? NaN);
  });

  it.each<[Mode, string]>([
    ["stopped", "stopped"],
    ["fault", "stopped"],
    ["action", "busy"],
  ])("ends when the robot is in mode %s", async (mode, because) => {
    streamer.setTarget("a", 1.9);
    await robot.run(60);
    robot.mode = mode;
    await robot.run(60);
    expect(streamer.ended.value).toBe(because);
    await expectNothingMoreSent();
  });

  it("ends when the page is hidden, and the next input does not resume other joints", async () => {
    streamer.setTarget("a", 1.9);
    await robot.run(60);
    streamer.end("hidden");
    await expectNothingMoreSent();
    streamer.setTarget("b", 0.3);
    expect(streamer.targets.value["a"]).toBeCloseTo(robot.position[0] ?? NaN);
  });

  it("ends without a connection, and does not resume with it", async () => {
    robot.connected = false;
    streamer.setTarget("a", 1);
    await robot.run(ABANDON_MS + 200);
    expect(streamer.ended.value).toBe("no-connection");
    robot.connected = true;
    await expectNothingMoreSent();
  });

  it("ends when the robot is blocked", async () => {
    robot.blocked = true;
    streamer.setTarget("a", 1);
    await robot.run(STUCK_MS + 200);
    expect(streamer.ended.value).toBe("stuck");
  });

  it.each<[string, JogTarget | null]>([
    ["is idle", null],
    ["has a velocity", { kind: "jog", linear_m_s: [0, 0, 0.05], angular_rad_s: [0, 0, 0], frame: "tool", tool: false }],
  ])("takes the robot's positions as targets while it %s", async (_, velocity) => {
    if (velocity !== null) streamer.setVelocity(velocity);
    robot.position = [1.25, -0.5];
    await robot.run(40);
    expect(streamer.targets.value).toEqual({ a: 1.25, b: -0.5 });
    expect(streamer.goal.value).toBeNull();
  });
});

const up: JogTarget = { kind: "jog", linear_m_s: [0, 0, 0.05], angular_rad_s: [0, 0, 0], frame: "tool", tool: false };
const upAtRest: JogTarget = { ...up, linear_m_s: [0, 0, 0] };
const ahead: DriveTarget = { kind: "drive", forward_m_s: 0.2, left_m_s: 0, turn_rad_s: 0 };
const atRest: DriveTarget = { kind: "drive", forward_m_s: 0, left_m_s: 0, turn_rad_s: 0 };

describe("a velocity", () => {
  const newest = (): Setpoint["target"] | undefined => robot.sent.at(-1)?.target;

  it("is sent while its control is held, and zero immediately after the release", async () => {
    streamer.setVelocity(up);
    expect(robot.sent).toHaveLength(1);
    await robot.run(1_000);
    expect(robot.sent.length).toBeGreaterThan(25);
    for (const { target } of robot.sent) expect(target).toEqual(up);
    expect([streamer.steeringMode.value, streamer.velocity.value]).toEqual(["jog", up]);

    const count = robot.sent.length;
    streamer.release();
    expect(robot.sent).toHaveLength(count + 1);
    expect(streamer.velocity.value).toBeNull();
    await robot.run(SETTLE_MS + 100);
    for (const { target } of robot.sent.slice(count)) expect(target).toEqual(upAtRest);
    expect([streamer.state.value, streamer.ended.value]).toEqual(["idle", "released"]);
    await expectNothingMoreSent();
  });

  it("can change while it is held, and ends when it becomes zero", async () => {
    streamer.setVelocity(ahead);
    await robot.run(60);
    streamer.setVelocity({ ...ahead, turn_rad_s: 0.5 });
    await robot.run(60);
    expect(newest()).toEqual({ ...ahead, turn_rad_s: 0.5 });
    streamer.setVelocity(atRest);
    expect(newest()).toEqual(atRest);
    expect(streamer.velocity.value).toBeNull();
  });

  it("does not start a stream if it is zero or invalid", async () => {
    streamer.setVelocity(atRest);
    streamer.setVelocity({ ...ahead, forward_m_s: NaN });
    await robot.run(100);
    expect(robot.sent).toEqual([]);
  });

  it.each(["hidden", "stopped", null] as const)("ends with zero when the stream ends (%s)", async (because) => {
    streamer.setVelocity(ahead);
    await robot.run(100);
    streamer.end(because);
    expect(newest()).toEqual(atRest);
    await expectNothingMoreSent();
    expect(streamer.ended.value).toBe(because);
  });

  it("does not resume after telemetry was missing for longer than the robot's watchdog", async () => {
    streamer.setVelocity(ahead);
    await robot.run(100);
    robot.silent = true;
    await robot.run(FRESH_MS + LOST_MS + 100);
    expect(streamer.ended.value).toBe("no-telemetry");
    robot.silent = false;
    await expectNothingMoreSent();
  });

  it("ends at the first setpoint that cannot be sent", async () => {
    streamer.setVelocity(ahead);
    await robot.run(100);
    robot.connected = false;
    await robot.run(60);
    expect(streamer.ended.value).toBe("no-connection");
    robot.connected = true;
    await expectNothingMoreSent();
  });

  it("replaces joint targets, which end at the current positions", async () => {
    streamer.setTarget("a", 2);
    await robot.run(200);
    const [position] = robot.position;
    streamer.setVelocity(ahead);
    expect(robot.newest()?.["a"]).toBeCloseTo(position ?? NaN);
    const count = robot.sent.length;
    await robot.run(100);
    for (const { target } of robot.sent.slice(count)) expect(target).toEqual(ahead);
    expect(streamer.goal.value).toBeNull();
  });

  it("becomes zero before another kind of velocity or joint targets start", async () => {
    streamer.setVelocity(up);
    await robot.run(60);
    streamer.setVelocity(ahead);
    expect(newest()).toEqual(upAtRest);
    await robot.run(60);
    expect(newest()).toEqual(ahead);
    streamer.setTarget("a", 2);
    expect(newest()).toEqual(atRest);
    await robot.run(60);
    expect(robot.newest()).toEqual({ a: 2, b: 0.25 });
    streamer.release(); // No velocity is active, so this has no effect.
    await robot.run(60);
    expect(streamer.steeringMode.value).toBe("joints");
  });
});

/** Blocks the page's timers for `ms`: the clock advances, but no timer runs. */
function freeze(ms: number): void {
  vi.setSystemTime(Date.now() + ms);
  clockSkew += ms;
}
let clockSkew = 0;
const DRIVE: DriveTarget = { kind: "drive", forward_m_s: 0.3, left_m_s: 0, turn_rad_s: 0 };

describe("a gap in the setpoints", () => {
  beforeEach(() => {
    clockSkew = 0;
    const measured = performance.now.bind(performance);
    vi.spyOn(performance, "now").mockImplementation(() => measured() + clockSkew);
  });
  afterEach(() => {
    vi.restoreAllMocks();
  });

  it("of a busy browser pauses the input, which continues only after a new press, with a higher number", async () => {
    streamer.begin();
    streamer.setTarget("a", 1.9);
    await robot.run(200);
    freeze(WATCHDOG_MS + 20);
    await robot.run(40);
    expect([streamer.state.value, streamer.ended.value]).toEqual(["idle", "paused"]);
    expect(streamer.pause.value?.cause).toBe("browser");
    expect(streamer.pause.value?.ms).toBeGreaterThanOrEqual(WATCHDOG_MS + 20);
    expect(streamer.pause.value?.ms).toBeLessThan(WATCHDOG_MS + 80);
    expect(streamer.targets.value["a"]).toBeCloseTo(robot.position[0] ?? NaN);
    streamer.setTarget("a", 1.5);
    streamer.setVelocity(DRIVE);
    await expectNothingMoreSent();
    streamer.begin();
    streamer.setTarget("a", 1.5);
    await robot.run(100);
    expect([streamer.state.value, robot.sent.at(-1)?.input]).toEqual(["streaming", 2]);
  });

  it("also ends an input that rests at its target, but not the press that follows the gap", async () => {
    streamer.begin();
    streamer.setTarget("a", 0.6);
    await robot.run(1_000);
    expect(streamer.ended.value).toBe("reached");
    streamer.setTarget("a", 0.7);
    await robot.run(1_000);
    expect(robot.position[0]).toBeCloseTo(0.7);
    const count = robot.sent.length;
    freeze(2_000);
    robot.measure();
    streamer.setTarget("a", 1.9);
    expect(robot.sent).toHaveLength(count);
    freeze(2_000);
    streamer.begin();
    robot.measure();
    streamer.setTarget("a", 1.9);
    expect(robot.sent.at(-1)?.input).toBe(2);
  });

  it("that the robot reports pauses the input, and the numbers continue above the reported one", async () => {
    streamer.begin();
    streamer.setTarget("a", 1.9);
    await robot.run(100);
    robot.endedInput = 4;
    await robot.run(60);
    expect([streamer.state.value, streamer.ended.value]).toEqual(["idle", "paused"]);
    await expectNothingMoreSent();
    streamer.begin();
    streamer.setTarget("a", 1.9);
    expect(robot.sent.at(-1)?.input).toBe(5);
  });

  it("of a velocity sends nothing more, not even velocity zero", async () => {
    streamer.begin();
    streamer.setVelocity(DRIVE);
    await robot.run(100);
    robot.endedInput = 1;
    const count = robot.sent.length;
    await robot.run(60);
    expect(streamer.ended.value).toBe("paused");
    expect(robot.sent.length).toBeLessThanOrEqual(count + 1);
    expect(robot.sent.at(-1)?.target).toEqual(DRIVE);
  });

  it("is announced by a warning while it is short, which ends with the delay", async () => {
    streamer.begin();
    streamer.setTarget("a", 1.9);
    await robot.run(100);
    expect(streamer.warning.value).toBeNull();
    freeze(150);
    await robot.run(40);
    expect(streamer.state.value).not.toBe("idle");
    expect(streamer.warning.value?.cause).toBe("browser");
    robot.blocked = true;
    await robot.run(1_600);
    expect(streamer.warning.value).toBeNull();
  });
});
