import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";
import { comparedColumns, plotColumns, Replay } from "../../../../src/features/autonomy/model/recording";
import { Comparison, readSelection, selectionText } from "../../../../src/features/autonomy/model/recording/comparison";
import { differencesOf, figuresOf } from "../../../../src/features/autonomy/model/recording/comparison/differences";
import { type Overview, readOverview } from "../../../../src/features/autonomy/model/recording/overview";
import { degrees } from "../../../../src/shared/lib/angles";
import type { RecordedSession } from "../../../../src/shared/api/recordings";
import { bytes } from "../../../support/messages";
import { JOINTS, recordedSession, writeOverview } from "../../../support/recordings";

interface Contents {
  from_s: number;
  to_s: number;
  yaw: (time_s: number) => number;
  source?: (time_s: number) => string;
  mode?: (time_s: number) => string;
  gap?: readonly [number, number];
  joints?: readonly string[];
}

/** Samples in which the first joint moves, and the second one rests. */
function samples({ from_s, to_s, yaw, source = () => "operator", mode = () => "streaming", gap = [0, 0], joints = JOINTS }: Contents): Overview {
  const times = Array.from({ length: Math.round((to_s - from_s) * 5) }, (_, index) => Number((from_s + index / 5).toFixed(3))).filter((time) => time < gap[0] || time >= gap[1]);
  const position_rad = times.map((time) => [yaw(time), 1]);
  return readOverview(bytes({ joints, time_s: times, position_rad, applied_rad: position_rad, source: times.map(source), mode: times.map(mode) }));
}

describe("the selection in an address", () => {
  it.each([
    [{ device: "arm-1", epoch: 7, first_s: 0, second_s: 0 }, "arm-1,7"],
    [{ device: "a_b", epoch: 12, first_s: 1.5, second_s: 20 }, "a_b,12,1500,20000"],
  ])("%j is read as it was written", (selection, text) => {
    expect(selectionText(selection)).toBe(text);
    expect(readSelection(text)).toEqual(selection);
  });

  it.each(["", "arm", "arm,", "arm,0", "arm,x", "arm,7,5", "arm,7,-5,5", "arm,7,1,2,3", ",7", "arm,7,1,99999999999"])("%j is none", (text) => {
    expect(readSelection(text)).toBeNull();
  });
});

describe("the difference of two sessions", () => {
  it("is that of the positions at the same time, between the samples", () => {
    const first = samples({ from_s: 0, to_s: 10, yaw: (time) => time });
    const second = samples({ from_s: 100.1, to_s: 120, yaw: (time) => time - 100 });
    const { overlap_s, joints } = differencesOf([first], [second], 100);
    expect(overlap_s).toBeCloseTo(9.8, 6); // the first sample of the first session is before the second session
    expect(joints.map(({ joint }) => joint)).toEqual(JOINTS);
    expect(joints[0]?.rms_rad).toBeCloseTo(0, 6);
    expect(joints[1]?.max_rad).toBe(0);
  });

  it("has the root mean square, the largest difference and its time", () => {
    const first = samples({ from_s: 0, to_s: 10, yaw: () => 0 });
    const second = samples({ from_s: 0, to_s: 10, yaw: (time) => (time < 5 ? 3 : time === 7 ? -8 : 4) });
    const [yaw] = differencesOf([first], [second], 0).joints;
    expect([yaw?.max_rad, yaw?.max_at_s]).toEqual([8, 7]);
    expect(yaw?.rms_rad).toBeCloseTo(Math.sqrt((25 * 9 + 24 * 16 + 64) / 50), 9);
  });

  it("does not contain times without data, and continues over two segments", () => {
    const first = [samples({ from_s: 0, to_s: 5, yaw: () => 0 }), samples({ from_s: 5, to_s: 10, yaw: () => 0 })];
    const second = samples({ from_s: 0, to_s: 10, yaw: (time) => (time < 3 ? 0 : 1), gap: [3, 8] });
    const { overlap_s, joints } = differencesOf(first, [second], 0);
    expect(overlap_s).toBeCloseTo(5, 6);
    expect(joints[0]?.rms_rad).toBeCloseTo(Math.sqrt(10 / 25), 9);
    expect(differencesOf([second], first, 0).overlap_s).toBeCloseTo(5, 6);
  });

  it("does not exist without a common time", () => {
    const one = samples({ from_s: 0, to_s: 5, yaw: () => 0 });
    expect(differencesOf([one], [samples({ from_s: 20, to_s: 30, yaw: () => 0 })], 0)).toEqual({ overlap_s: 0, joints: [] });
    expect(differencesOf([], [one], 0)).toEqual({ overlap_s: 0, joints: [] });
  });
});

describe("the figures of a session", () => {
  it("are the way of each joint without gaps, the shares of the sources, and the numbers of stops and faults", () => {
    const source = (time: number): string => (time < 2 ? "operator" : time < 4 ? "stop" : time < 8 ? "movement" : "stop");
    const mode = (time: number): string => (time === 5 || time === 7 ? "fault" : "action");
    const pieces = [samples({ from_s: 0, to_s: 6, yaw: (time) => Math.abs(time - 3), source, mode }), samples({ from_s: 6, to_s: 12, yaw: (time) => time - 3, source, mode, gap: [9, 11] })];
    const { recorded_s, path_rad, shares, stops, faults } = figuresOf(pieces);
    expect([recorded_s, path_rad[0], path_rad[1]].map((value) => Number((value ?? NaN).toFixed(6)))).toEqual([10, 9.6, 0]);
    expect([shares.operator, shares.movement, shares.hold, shares.stop].map((value) => Number(value.toFixed(6)))).toEqual([0.2, 0.4, 0, 0.4]);
    expect([stops, faults]).toEqual([2, 2]);
  });

  it("of a session without samples are zero", () => {
    expect(figuresOf([])).toEqual({ recorded_s: 0, path_rad: [], shares: { operator: 0, movement: 0, hold: 0, stop: 0 }, stops: 0, faults: 0 });
  });
});

describe("the lines of two sessions", () => {
  it("have one time axis, on which a missing value interrupts no line", () => {
    const first = plotColumns([samples({ from_s: 0, to_s: 0.6, yaw: () => 1 })], [0]);
    const second = plotColumns([samples({ from_s: 10.2, to_s: 10.9, yaw: () => 2 })], [0]);
    const { time_s, solid, dashed } = comparedColumns(first, second, 10.1);
    expect(time_s.map((time) => Number(time.toFixed(3)))).toEqual([0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.7]);
    expect(solid[0]).toEqual([degrees(1), undefined, degrees(1), undefined, degrees(1), undefined, undefined]);
    expect(dashed[0]).toEqual([undefined, degrees(2), undefined, degrees(2), undefined, degrees(2), degrees(2)]);
    expect(comparedColumns(first, second, 10.2).time_s.length).toBe(4);
  });
});

describe("a comparison", () => {
  let replays: Replay[];
  let comparison: Comparison;
  let sessions: RecordedSession[];
  let overviews: Uint8Array[];

  beforeEach(() => {
    vi.useFakeTimers();
    sessions = [recordedSession([0]), recordedSession([0])];
    overviews = [writeOverview(0, 60), writeOverview(0, 30)];
  });
  afterEach(() => {
    comparison.dispose();
    replays.forEach((replay) => replay.dispose());
    vi.useRealTimers();
  });

  const open = async (): Promise<void> => {
    replays = [0, 1].map(
      (number) =>
        new Replay({
          session: () => Promise.resolve({ body: sessions[number] ?? recordedSession([]), etag: "1" }),
          file: () => Promise.resolve(overviews[number] ?? new Uint8Array()),
          segment: () => new Promise(() => undefined),
          save: () => Promise.resolve("2"),
        }),
    );
    const [first, second] = replays as [Replay, Replay];
    comparison = new Comparison(first, second);
    await Promise.all(replays.map((replay) => replay.refresh()));
    await vi.advanceTimersByTimeAsync(100);
  };
  const yawAt = (): number | null => {
    const moment = comparison.moment.value;
    return moment.kind === "none" ? null : (moment.samples.position_rad[moment.index * 2] ?? null);
  };

  it("follows the cursor of the first session, and has no data outside the second", async () => {
    await open();
    expect(comparison.state.value).toBe("ready");
    comparison.first.seek(20);
    expect(yawAt()).toBe(20);
    comparison.first.seek(31);
    expect(yawAt()).toBeNull();
  });

  it("shows moments that belong together at the same time", async () => {
    await open();
    comparison.align({ first_s: 40, second_s: 10 });
    comparison.first.seek(45);
    expect(yawAt()).toBe(15);
    expect(comparison.window.value).toEqual({ from_s: -30, to_s: 30 });
    comparison.first.seek(29);
    expect(yawAt()).toBeNull();
    expect(comparison.differences.value.overlap_s).toBeCloseTo(30, 6);
  });

  it("states that the sessions have no common time", async () => {
    await open();
    comparison.align({ first_s: 0, second_s: 50 });
    expect(comparison.state.value).toBe("apart");
  });

  it("states that the joints differ", async () => {
    overviews[1] = bytes({ ...(JSON.parse(new TextDecoder().decode(overviews[1])) as object), joints: ["elbow", "wrist"] });
    await open();
    expect([comparison.state.value, comparison.differences.value.joints]).toEqual(["joints", []]);
  });

  it("states that the second session has no recording", async () => {
    sessions[1] = { ...recordedSession([]), recording: null };
    await open();
    expect(comparison.state.value).toBe("empty");
  });
});
