import { plan } from "../../../src/features/keyframes/model/plan";
import { type Problem, placeOf, problems, stretchAll } from "../../../src/features/keyframes/model/problems";
import { readFileSync } from "node:fs";
import { describe, expect, test } from "vitest";
import { addAfter, duplicate, remove, setPosition, setTime, normalize, type Keyframe, type Movement } from "../../../src/features/keyframes/model/keyframes";
import { readMovement, readScript, writeScript } from "../../../src/features/keyframes/model/script-codec";
import { Recorder, trimmedGaps, keyframesOf, trim, type Sample } from "../../../src/features/keyframes/model/recording";
import { UndoHistory } from "../../../src/shared/lib/undo-history";
import type { KnownTelemetry } from "../../../src/shared/mqtt/parse-messages";
import { head } from "../../support/robots";

const robot = head();

function movement(...keyframes: Keyframe[]): Movement {
  return { description: "Nods.", keyframes };
}

function frame(time_s: number, position_rad: Record<string, number>, more: Partial<Keyframe> = {}): Keyframe {
  return { time_s, position_rad, ...more };
}

function joint(name: string) {
  const found = robot.joints.find((one) => one.name === name);
  if (found === undefined) throw new Error(name);
  return found;
}

function kinds(found: readonly Problem[]): string[] {
  return found.map(({ keyframe, joint: name, what }) => `${keyframe} ${name ?? "-"} ${what.kind}`);
}

function times(made: Movement): number[] {
  return made.keyframes.map(({ time_s }) => time_s);
}

describe("edits", () => {
  const three = movement(frame(0, { yaw: 0 }), frame(1, { yaw: 0.5 }), frame(2, { yaw: 0 }));

  test("a keyframe stays between its neighbours, or takes those that follow along", () => {
    expect(times(setTime(three, 1, 9, false))).toEqual([0, 1.95, 2]);
    expect(times(setTime(three, 1, -9, false))).toEqual([0, 0.05, 2]);
    expect(times(setTime(three, 1, 3, true))).toEqual([0, 3, 4]);
    expect(times(setTime(three, 0, 3, true))).toEqual([0, 1, 2]);
    expect(times(setTime(three, 1, 700, true))).toEqual([0, 599, 600]);
  });

  test("added, copied, taken away", () => {
    expect(times(addAfter(three, 0, { yaw: 0.2 }))).toEqual([0, 0.5, 1, 2]);
    expect(times(addAfter(three, 2, {}))).toEqual([0, 1, 2, 3]);
    expect(times(duplicate(three, 0))).toEqual([0, 1, 2, 3]);
    expect(times(remove(three, 0))).toEqual([0, 1]);
    expect(remove(movement(frame(0, {})), 0).keyframes).toHaveLength(1);
  });

  test("of joints that one motor moves the one that counts is set, and positions are inside of their range", () => {
    const made = setPosition(three, 1, joint("right"), 0.1, robot);
    expect(made.keyframes[1]?.position_rad).toEqual({ yaw: 0.5, left: -0.2 });
    expect(setPosition(three, 1, joint("yaw"), 99, robot).keyframes[1]?.position_rad).toEqual({ yaw: 2 });
    expect(setPosition(three, 1, joint("yaw"), null, robot).keyframes[1]?.position_rad).toEqual({});
    expect(normalize(2.085669, -2, 2.085669)).toBe(2.0856);
    expect(normalize(-2.085669, -2.085669, 2)).toBe(-2.0856);
  });

  test("every change can be taken back, and a drag is one change", () => {
    const history = new UndoHistory(0);
    history.change(1, "slider");
    history.change(2, "slider");
    history.change(3);
    history.undo();
    expect(history.now.value).toBe(2);
    history.undo();
    expect(history.now.value).toBe(0);
    expect(history.canUndo.value).toBe(false);
    history.redo();
    history.change(7);
    expect(history.canRedo.value).toBe(false);
    history.undo();
    expect(history.now.value).toBe(2);
  });
});

describe("checks", () => {
  test("what is good has no problem", () => {
    expect(problems(movement(frame(0, { yaw: 0 }), frame(1, { yaw: 0.5 }, { say: "hello" })), robot)).toEqual([]);
  });

  test("each is named at its keyframe and joint, and mended by what it offers", () => {
    const wrong = movement(
      frame(0, { yaw: 0 }),
      frame(3, { yaw: 2.5, nose: 1 }),
      frame(6, { yaw: 2, pitch: -0.6 }),
      frame(8, { left: 0.2, right: 0.2 }),
      frame(9, {}, { posture: "Fly", behaviour: "nod" }),
    );
    const found = problems(wrong, robot);
    expect(kinds(found)).toEqual([
      "1 yaw range",
      "1 nose unknown-joint",
      "2 pitch narrowed",
      "2 pitch late-joint",
      "3 right mirrored",
      "3 left late-joint",
      "4 - unknown-name",
      "4 - cannot",
    ]);
    const mended = found.reduce((now, { mend }) => mend?.(now) ?? now, wrong);
    expect(kinds(problems(mended, robot))).toEqual([]);
    expect(mended.keyframes[2]?.position_rad["pitch"]).toBeCloseTo(-0.4);
  });

  test("what is too fast says how long it needs, and one mend is enough", () => {
    const fast = movement(frame(0, { yaw: 0 }), frame(0.2, { yaw: 1 }), frame(3, { yaw: 0 }));
    const [found] = problems(fast, robot);
    expect(kinds(problems(fast, robot))).toEqual(["1 yaw too-fast"]);
    const mended = found?.mend?.(fast) ?? fast;
    expect(problems(mended, robot)).toEqual([]);
    const needs = found?.what.kind === "too-fast" ? found.what.needs_s : NaN;
    expect(mended.keyframes[1]?.time_s).toBe(needs);
    expect(needs).toBeGreaterThan(0.7);
    expect(needs).toBeLessThan(1);
    expect((mended.keyframes[2]?.time_s ?? 0) - needs).toBeCloseTo(2.8);
    // The robot itself would take as long.
    expect(plan(fast, robot).reached_s[1]).toBeCloseTo(needs, 1);
  });

  test("all that is too fast can be mended at once", () => {
    const fast = movement(...[0, 1, 1.8, -1, 1].map((yaw, index) => frame(index / 10, { yaw, left: yaw / 4 })));
    expect(problems(stretchAll(fast, robot), robot)).toEqual([]);
  });

  test("times that do not rise are the first thing to mend", () => {
    const wrong = movement(frame(1, { yaw: 0 }), frame(0.5, { yaw: 0.1 }), frame(9, { yaw: 0 }));
    const found = problems(wrong, robot);
    expect(kinds(found)).toEqual(["0 - times", "1 - times"]);
    expect(times(found[0]?.mend?.(wrong) ?? wrong)).toEqual([0, 0.05, 8]);
  });
});

describe("the plan", () => {
  test("time stands still where something is done, and joints rest there", () => {
    const made = movement(frame(0, { yaw: 0 }), frame(1, { yaw: 0.5 }, { say: "hi" }), frame(2, { yaw: 1 }));
    const found = plan(made, robot);
    expect(found.duration_s).toBeCloseTo(2.8);
    expect(found.at(1.4)["yaw"]).toBeCloseTo(0.5);
    expect(found.asked(1.4)).toBeCloseTo(1);
    expect(found.played(1.5)).toBeGreaterThan(2);
  });

  test("a joint that is not named is on its way", () => {
    const made = movement(frame(0, { yaw: 0, left: 0 }), frame(1, { left: 0.1 }), frame(2, { yaw: 1, left: 0.2 }));
    expect(placeOf(made, 1, "yaw")).toBeCloseTo(0.5);
    expect(plan(made, robot).at(1)["yaw"]).toBeCloseTo(0.5);
    expect(plan(movement(frame(0, { yaw: 0.3 })), robot).at(7)).toEqual({ yaw: 0.3 });
  });
});

describe("the script", () => {
  const made = movement(
    frame(0, { yaw: 0 }),
    frame(1.5, { yaw: 0.5, left: -0.25 }, { express: "smile", say: 'He said "no" \\ ž\n' }),
    frame(2, {}, { drive: { forward_m_s: 0.1, turn_rad_s: 0, duration_s: 2 }, go_to: { x_m: 1, y_m: -2 } }),
  );

  test("is read back as it was written", () => {
    expect(readScript(writeScript(made))).toEqual({ kind: "keyframes", movement: made });
    expect(readMovement(JSON.parse(JSON.stringify(made)))).toEqual(made);
  });

  test("is what the robot's own tests run", () => {
    const reaches = movement(
      frame(0, { shoulder_pan: 0, shoulder_lift: -1.57, elbow: 1.57, wrist_1: -1.57, wrist_2: -1.57, wrist_3: 0 }),
      frame(0.8, { shoulder_pan: 0.3, elbow: 1.4 }),
      frame(1.6, { shoulder_pan: 0.5, elbow: 1.57 }),
    );
    const source = writeScript({ ...reaches, description: "Reaches to the left." });
    expect(source).toBe(readFileSync(new URL("../../fixtures/keyframes.py", import.meta.url), "utf8"));
  });

  test("in words that end no docstring", () => {
    const said = readScript(writeScript({ ...made, description: 'a """ b\nc \\' }));
    expect(said.kind === "keyframes" && said.movement.description).toBe("a ''' b c /");
  });

  test.each([
    ["a line more", (source: string) => `${source}robot.home()\n`],
    ["another speed", (source: string) => source.replace('"default": 1', '"default": 2')],
    ["a number that is computed", (source: string) => source.replace("0.5", "1 / 2")],
    ["an unknown key", (source: string) => source.replace('"express"', '"shout"')],
    ["an infinite time", (source: string) => source.replace("1.5", "1e999")],
    ["no keyframe", (source: string) => source.replace(/ {4}\{"time_s.*\n/gu, "")],
    ["no end", (source: string) => source.replace("\n]\n", "\n")],
  ])("with %s belongs into the code editor", (_, change) => {
    expect(readScript(change(writeScript(made)))).toEqual({ kind: "changed" });
  });

  test("written by hand is not read as keyframes", () => {
    expect(readScript('"""Wave."""\nrobot.home()\n')).toEqual({ kind: "other" });
  });

  test("what was kept and is none is nothing", () => {
    for (const value of [null, 3, {}, { description: "", keyframes: [] }, { description: "", keyframes: [{ time_s: "1" }] }]) {
      expect(readMovement(value)).toBeNull();
    }
  });
});

describe("a recording", () => {
  function heard(tick_ms: number, ...position_rad: number[]): KnownTelemetry {
    return { tick_ms, at_ms: 1_000_000 + tick_ms, position_rad } as unknown as KnownTelemetry;
  }

  test("has its gaps marked, goes on after the robot's clock began again, and hears what was said", () => {
    const recorder = new Recorder();
    recorder.hear(heard(0, 0, 0, 0, 0));
    recorder.start();
    for (const tick of [1000, 1050, 1100, 3100, 3150]) recorder.hear(heard(tick, tick / 1000, 0, 0, 0));
    recorder.hearEvent({ kind: "speech-started", at_ms: 1_003_150, data: { text: "hello" } } as never);
    recorder.hear({ ...heard(20, 4, 0, 0, 0), at_ms: 1_004_150 });
    recorder.stop();
    recorder.hear(heard(5000, 9, 0, 0, 0));
    const take = recorder.take.value;
    expect(take.samples.map(({ time_s }) => Number(time_s.toFixed(2)))).toEqual([0, 0.05, 0.1, 2.1, 2.15, 3.15]);
    expect(take.gaps.map(({ from_s, to_s }) => [from_s.toFixed(2), to_s.toFixed(2)])).toEqual([
      ["0.10", "2.10"],
      ["2.15", "3.15"],
    ]);
    expect(take.said[0]?.time_s).toBeCloseTo(2.15);
    expect(trim(take, 2, 9).gaps).toHaveLength(1);
    const made = keyframesOf(trim(take, 2, 9), 0.01, robot);
    expect(made[0]?.time_s).toBe(0);
    expect(made.some(({ say }) => say === "hello")).toBe(true);
  });

  test("becomes as few keyframes as come near enough to it", () => {
    const samples: Sample[] = Array.from({ length: 101 }, (_, index) => {
      const time_s = index / 20;
      return { time_s, position_rad: [Math.min(time_s, 5 - time_s) / 5, 0.3, 0, 0] };
    });
    expect(trimmedGaps(samples, 0.01, new Set())).toEqual([0, 50, 100]);
    const made = keyframesOf({ samples, gaps: [], said: [] }, 0.01, robot);
    expect(made.map(({ time_s }) => time_s)).toEqual([0, 2.5, 5]);
    expect(made[0]?.position_rad).toEqual({ yaw: 0, pitch: 0.3, left: 0 });
    expect(made[1]?.position_rad).toEqual({ yaw: 0.5 });
    expect(problems({ description: "", keyframes: made }, robot)).toEqual([]);
    const wobbly = samples.map((one, index) => ({ ...one, position_rad: [Math.sin(index / 8), 0, 0, 0] }));
    const few = trimmedGaps(wobbly, 0.1, new Set()).length;
    expect(few).toBeLessThan(trimmedGaps(wobbly, 0.01, new Set()).length);
    expect(keyframesOf({ samples: [], gaps: [], said: [] }, 0.01, robot)).toEqual([]);
  });
});
