import { describe, expect, it } from "vitest";
import { type AppliedSample, appliedBetween, replayScript } from "../../../../src/features/autonomy/model/recording/replay-script";
import { decodeSegment } from "../../../../src/features/autonomy/model/recording/decode-segment";
import { PERIOD_S, rowsFrom, writeSegment } from "../../../support/recordings";

const JOINTS = ["shoulder", "elbow"];
const samples = (count: number, at: (time: number) => number[]): AppliedSample[] =>
  Array.from({ length: count }, (_, index) => ({ time_s: 10 + index / 125, position_rad: at(index / 125) }));
const keyframesOf = (source: string): { time_s: number; position_rad: Record<string, number> }[] =>
  source
    .split("\n")
    .filter((line) => line.startsWith("    ["))
    .map((line) => {
      const [time_s = NaN, ...positions] = JSON.parse(line.replace(/,$/, "")) as number[];
      return { time_s, position_rad: Object.fromEntries(JOINTS.map((name, joint) => [name, positions[joint] ?? NaN])) };
    });

/** Largest distance of the samples from the lines between the keyframes. */
function deviation(all: readonly AppliedSample[], source: string): number {
  const keyframes = keyframesOf(source);
  let most = 0;
  for (const { time_s, position_rad } of all) {
    const time = time_s - (all[0]?.time_s ?? 0);
    const next = keyframes.findIndex((each) => each.time_s >= time - 1e-3);
    const [a, b] = [keyframes[Math.max(0, next - 1)], keyframes[next < 0 ? keyframes.length - 1 : next]];
    if (a === undefined || b === undefined) throw new Error("no keyframes");
    const share = b.time_s === a.time_s ? 0 : (time - a.time_s) / (b.time_s - a.time_s);
    JOINTS.forEach((name, joint) => {
      const [from, to] = [a.position_rad[name] ?? NaN, b.position_rad[name] ?? NaN];
      most = Math.max(most, Math.abs((position_rad[joint] ?? NaN) - (from + share * (to - from))));
    });
  }
  return most;
}

describe("the script of a replay", () => {
  it("follows the recording within its tolerance, with few keyframes", () => {
    const all = samples(1250, (time) => [Math.sin(time), 0.5 * Math.cos(2 * time)]);
    const script = replayScript({ description: "demo, 10 s", joints: JOINTS, samples: all });
    if ("error" in script) throw new Error(script.error);
    expect(deviation(all, script.source)).toBeLessThan(script.toleranceRad + 0.001);
    expect(script.keyframes).toBeLessThan(120);
    expect(keyframesOf(script.source)).toHaveLength(script.keyframes);
  });

  it("starts at time 0 with the first position and ends with the last one", () => {
    const all = samples(130, (time) => [time, -time]);
    const script = replayScript({ description: "", joints: JOINTS, samples: all });
    const keyframes = keyframesOf("source" in script ? script.source : "");
    expect(keyframes[0]).toEqual({ time_s: 0, position_rad: { shoulder: 0, elbow: 0 } });
    expect(keyframes.at(-1)?.position_rad["shoulder"]).toBeCloseTo(129 / 125, 4);
  });

  it("approaches the first position on a planned path", () => {
    const script = replayScript({ description: "x", joints: JOINTS, samples: samples(10, () => [0, 0]) });
    expect("source" in script && script.source).toContain("plan=True");
  });

  it("of a long recording has a larger tolerance instead of more text", () => {
    const all = samples(125 * 500, (time) => [Math.sin(2 * time), Math.cos(2.1 * time)]);
    const script = replayScript({ description: "ten minutes", joints: JOINTS, samples: all });
    if ("error" in script) throw new Error(script.error);
    expect(script.source.length).toBeLessThanOrEqual(65_536);
    expect(script.toleranceRad).toBeGreaterThan(0.0044);
    expect(deviation(all, script.source)).toBeLessThan(script.toleranceRad + 0.001);
  });

  it.each([
    ["it cannot be followed within four degrees", samples(125 * 400, (time) => [Math.sin(20 * time), Math.cos(21 * time)])],
    ["it lasts longer than ten minutes", samples(125 * 601, () => [0, 0])],
  ])("is rejected if %s", (_, all) => {
    expect(replayScript({ description: "", joints: JOINTS, samples: all })).toEqual({ error: "too-long" });
  });

  it("is rejected without samples", () => {
    expect(replayScript({ description: "", joints: JOINTS, samples: [] })).toEqual({ error: "empty" });
  });

  it("has a docstring of one line that its description cannot end", () => {
    const script = replayScript({ description: 'a """\nimport os', joints: JOINTS, samples: samples(10, () => [0, 0]) });
    expect("source" in script && script.source.split("\n")[0]).toBe("\"\"\"a ''' import os");
  });
});

describe("the applied positions of a part", () => {
  const segments = async () => [await decodeSegment(await writeSegment({ rows: [...rowsFrom(0, 20), ...rowsFrom(30, 60)] })), await decodeSegment(await writeSegment({ segment: 1, rows: rowsFrom(60, 70) }))];

  it("continue from one segment to the next", async () => {
    const applied = appliedBetween(await segments(), 59.5, 60.5);
    const times = "samples" in applied ? applied.samples.map(({ time_s }) => time_s) : [];
    expect(times).toHaveLength(101);
    expect([times[0], times.at(-1)]).toEqual([59.5, 60.5]);
  });

  it("remain the last ones while the agent is late", async () => {
    const rows = [...rowsFrom(0, 1), ...rowsFrom(1.5, 2).map((row, index) => ({ ...row, sequence: 100 + index }))];
    const segment = await decodeSegment(await writeSegment({ rows }));
    segment.applied_rad = Float64Array.from([...segment.time_s].flatMap((time) => [time, -time]));
    const applied = appliedBetween([segment], 0, 2);
    const found = "samples" in applied ? applied.samples : [];
    expect(found).toHaveLength(rows.length + 1);
    expect(found[100]?.time_s).toBeCloseTo(1.5 - PERIOD_S, 6);
    expect(found[100]?.position_rad).toEqual(found[99]?.position_rad);
    expect(found[101]?.position_rad[0]).toBeCloseTo(1.5, 6);
  });

  it("are rejected with missing rows, and without rows", async () => {
    expect(appliedBetween(await segments(), 15, 35)).toEqual({ error: "gap" });
    expect(appliedBetween(await segments(), 21, 29)).toEqual({ error: "empty" });
  });

  it("are rejected if the base moved", async () => {
    const found = await segments();
    const twist = found[1]?.twist;
    if (twist !== undefined) twist[3 * 50 + 1] = 0.1;
    expect(appliedBetween(found, 60, 61)).toEqual({ error: "base" });
    expect(appliedBetween(found, 61, 62)).toHaveProperty("samples");
  });
});
