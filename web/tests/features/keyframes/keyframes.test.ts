import { readFileSync } from "node:fs";
import { describe, expect, test } from "vitest";
import { addAfter, duplicate, remove, setPosition, setTime, normalize, type Keyframe, type Movement } from "../../../src/features/keyframes/model/keyframes";
import { plan } from "../../../src/features/keyframes/model/plan";
import { type Problem, positionAt, problems, stretchAll } from "../../../src/features/keyframes/model/problems";
import { Recorder, simplify, keyframesOf, trim, type Sample } from "../../../src/features/keyframes/model/recording";
import { readMovement, readScript, writeScript } from "../../../src/features/keyframes/model/script-codec";
import { texts } from "../../../src/features/keyframes/texts";
import { UndoHistory } from "../../../src/shared/lib/undo-history";
import type { KnownTelemetry } from "../../../src/shared/mqtt/parse-messages";
import { head } from "../../support/robots";

const robot = head();

const movement = (...keyframes: Keyframe[]): Movement => ({ description: "Nods.", keyframes });
const frame = (time_s: number, position_rad: Record<string, number>, more: Partial<Keyframe> = {}): Keyframe => ({ time_s, position_rad, ...more });
const times = ({ keyframes }: Movement): number[] => keyframes.map(({ time_s }) => time_s);

function kinds(found: readonly Problem[]): string[] {
  return found.map(({ keyframe, joint, what }) => `${keyframe} ${joint ?? "-"} ${what.kind}`);
}

describe("edits", () => {
  const three = movement(frame(0, { yaw: 0 }), frame(1, { yaw: 0.5 }), frame(2, { yaw: 0 }));

  test.each<[string, Movement, number[]]>([
    ["later, at most to the next keyframe", setTime(three, 1, 9, false), [0, 1.95, 2]],
    ["earlier, at most to the previous keyframe", setTime(three, 1, -9, false), [0, 0.05, 2]],
    ["later, with the following keyframes", setTime(three, 1, 3, true), [0, 3, 4]],
    ["never away from the start", setTime(three, 0, 3, true), [0, 1, 2]],
    ["at most to ten minutes", setTime(three, 1, 700, true), [0, 599, 600]],
    ["by insertion", addAfter(three, 0, { yaw: 0.2 }), [0, 0.5, 1, 2]],
    ["by addition at the end", addAfter(three, 2, {}), [0, 1, 2, 3]],
    ["by duplication", duplicate(three, 0), [0, 1, 2, 3]],
    ["by removal", remove(three, 0), [0, 1]],
    ["never to none", remove(movement(frame(0, {})), 0), [0]],
  ])("change the times %s", (_, made, expected) => {
    expect(times(made)).toEqual(expected);
  });

  test("set positions within the range, for coupled joints those of the driving joint", () => {
    const edited = (name: string, position: number | null): unknown => {
      const joint = robot.joints.find((each) => each.name === name);
      return joint && setPosition(three, 1, joint, position, robot).keyframes[1]?.position_rad;
    };
    expect(edited("right", 0.1)).toEqual({ yaw: 0.5, left: -0.2 });
    expect(edited("yaw", 99)).toEqual({ yaw: 2 });
    expect(edited("yaw", null)).toEqual({});
    expect([normalize(2.085669, -2, 2.085669), normalize(-2.085669, -2.085669, 2)]).toEqual([2.0856, -2.0856]);
  });

  test("can be undone and redone; a drag is one edit", () => {
    const history = new UndoHistory(0);
    history.change(1, "slider");
    history.change(2, "slider");
    history.change(3);
    history.undo();
    expect(history.now.value).toBe(2);
    history.undo();
    expect([history.now.value, history.canUndo.value]).toEqual([0, false]);
    history.redo();
    history.change(7);
    expect(history.canRedo.value).toBe(false);
    history.undo();
    expect(history.now.value).toBe(2);
  });
});

describe("checks", () => {
  test("name keyframe and joint of each problem, and offer a fix", () => {
    expect(problems(movement(frame(0, { yaw: 0 }), frame(1, { yaw: 0.5 }, { say: "hello" })), robot)).toEqual([]);
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
      "4 - unsupported",
    ]);
    const fixed = found.reduce((now, { fix }) => fix?.(now) ?? now, wrong);
    expect(kinds(problems(fixed, robot))).toEqual([]);
    expect(fixed.keyframes[2]?.position_rad["pitch"]).toBeCloseTo(-0.4);
  });

  test("name unknown controls and values outside of their limits; a robot type leaves both to its robots", () => {
    const set = (name: string, value: number): Movement => movement(frame(0, { yaw: 0 }, { set_control: { name, value } }));
    const fixed = (wrong: Movement): unknown => problems(wrong, robot)[0]?.fix?.(wrong).keyframes[0]?.set_control;
    expect([kinds(problems(set("gripper", 85), robot)), kinds(problems(set("gripper", -1), robot)), kinds(problems(set("lamp", 1), robot))]).toEqual([
      [],
      ["0 - control-range"],
      ["0 - unknown-name"],
    ]);
    expect(problems(set("gripper", 99), robot).map((problem) => texts.problem(problem, ""))).toEqual(["Gripper can be set from 0 to 85 mm."]);
    expect([fixed(set("gripper", 99)), fixed(set("lamp", 1))]).toEqual([{ name: "gripper", value: 85 }, undefined]);
    const without = { ...robot, actions: ["move_joints"], controls: [] };
    expect(kinds(problems(set("gripper", 1), without))).toEqual(["0 - unsupported"]);
    expect(problems(set("lamp", 99), { ...without, controls: null })).toEqual([]);
  });

  test("state the time that a too fast segment needs; a fix exists for one and for all segments", () => {
    const fast = movement(frame(0, { yaw: 0 }), frame(0.2, { yaw: 1 }), frame(3, { yaw: 0 }));
    const [found] = problems(fast, robot);
    expect(kinds(problems(fast, robot))).toEqual(["1 yaw too-fast"]);
    const fixed = found?.fix?.(fast) ?? fast;
    expect(problems(fixed, robot)).toEqual([]);
    const needs = found?.what.kind === "too-fast" ? found.what.needs_s : NaN;
    expect(needs > 0.7 && needs < 1).toBe(true);
    expect(times(fixed)).toEqual([0, needs, expect.closeTo(needs + 2.8) as number]);
    // The robot needs the same time.
    expect(plan(fast, robot).reached_s[1]).toBeCloseTo(needs, 1);
    const faster = movement(...[0, 1, 1.8, -1, 1].map((yaw, index) => frame(index / 10, { yaw, left: yaw / 4 })));
    expect(problems(stretchAll(faster, robot), robot)).toEqual([]);
  });

  test("report decreasing times first", () => {
    const wrong = movement(frame(1, { yaw: 0 }), frame(0.5, { yaw: 0.1 }), frame(9, { yaw: 0 }));
    const found = problems(wrong, robot);
    expect(kinds(found)).toEqual(["0 - times", "1 - times"]);
    expect(times(found[0]?.fix?.(wrong) ?? wrong)).toEqual([0, 0.05, 8]);
  });
});

describe("the plan", () => {
  test("includes the duration of other activities, during which joints rest", () => {
    const made = movement(frame(0, { yaw: 0 }), frame(1, { yaw: 0.5 }, { say: "hi" }), frame(2, { yaw: 1 }));
    const found = plan(made, robot);
    expect(found.duration_s).toBeCloseTo(2.8);
    expect(found.at(1.4)["yaw"]).toBeCloseTo(0.5);
    expect(found.keyframeTime(1.4)).toBeCloseTo(1);
    expect(found.previewTime(1.5)).toBeGreaterThan(2);
  });

  test("interpolates joints that a keyframe does not name", () => {
    const made = movement(frame(0, { yaw: 0, left: 0 }), frame(1, { left: 0.1 }), frame(2, { yaw: 1, left: 0.2 }));
    expect(positionAt(made, 1, "yaw")).toBeCloseTo(0.5);
    expect(plan(made, robot).at(1)["yaw"]).toBeCloseTo(0.5);
    expect(plan(movement(frame(0, { yaw: 0.3 })), robot).at(7)).toEqual({ yaw: 0.3 });
  });
});

describe("the script", () => {
  const made = movement(
    frame(0, { yaw: 0 }),
    frame(1.5, { yaw: 0.5, left: -0.25 }, { express: "smile", say: 'He said "no" \\ ž\n' }),
    frame(2, {}, { drive: { forward_m_s: 0.1, turn_rad_s: 0, duration_s: 2 }, go_to: { x_m: 1, y_m: -2 } }),
    frame(3, {}, { set_control: { name: "gripper", value: 0.4 } }),
  );

  test("is read back as it was written", () => {
    expect(readScript(writeScript(made))).toEqual({ kind: "keyframes", movement: made });
    expect(readMovement(JSON.parse(JSON.stringify(made)))).toEqual(made);
  });

  test("equals the fixture that the agent's tests run", () => {
    const reaches = movement(
      frame(0, { shoulder_pan: 0, shoulder_lift: -1.57, elbow: 1.57, wrist_1: -1.57, wrist_2: -1.57, wrist_3: 0 }),
      frame(0.8, { shoulder_pan: 0.3, elbow: 1.4 }),
      frame(1.6, { shoulder_pan: 0.5, elbow: 1.57 }),
    );
    const source = writeScript({ ...reaches, description: "Reaches to the left." });
    expect(source).toBe(readFileSync(new URL("../../fixtures/keyframes.py", import.meta.url), "utf8"));
  });

  test("escapes the description", () => {
    const parsed = readScript(writeScript({ ...made, description: 'a """ b\nc \\' }));
    expect(parsed.kind === "keyframes" && parsed.movement.description).toBe("a ''' b c /");
  });

  test.each([
    ["an additional line", (source: string) => `${source}robot.home()\n`],
    ["another speed", (source: string) => source.replace('"default": 1', '"default": 2')],
    ["a computed number", (source: string) => source.replace("0.5", "1 / 2")],
    ["an unknown key", (source: string) => source.replace('"express"', '"shout"')],
    ["a control without a value", (source: string) => source.replace(', "value": 0.4', "")],
    ["a control that is a text", (source: string) => source.replace('{"name": "gripper", "value": 0.4}', '"gripper"')],
    ["an infinite time", (source: string) => source.replace("1.5", "1e999")],
    ["no keyframe", (source: string) => source.replace(/ {4}\{"time_s.*\n/gu, "")],
    ["no end", (source: string) => source.replace("\n]\n", "\n")],
  ])("with %s opens in the code editor", (_, change) => {
    expect(readScript(change(writeScript(made)))).toEqual({ kind: "changed" });
  });

  test("is not read from other scripts or invalid drafts", () => {
    expect(readScript('"""Wave."""\nrobot.home()\n')).toEqual({ kind: "other" });
    for (const value of [null, 3, {}, { description: "", keyframes: [] }, { description: "", keyframes: [{ time_s: "1" }] }]) {
      expect(readMovement(value)).toBeNull();
    }
  });
});

describe("a recording", () => {
  const sample = (tick_ms: number, yaw: number): KnownTelemetry =>
    ({ tick_ms, at_ms: 1_000_000 + tick_ms, position_rad: [yaw, 0, 0, 0] }) as unknown as KnownTelemetry;

  test("marks gaps, continues after a restart of the robot's clock, and contains speech", () => {
    const recorder = new Recorder();
    recorder.addTelemetry(sample(0, 0));
    recorder.start();
    for (const tick of [1000, 1050, 1100, 3100, 3150]) recorder.addTelemetry(sample(tick, tick / 1000));
    recorder.addEvent({ kind: "speech-started", at_ms: 1_003_150, data: { text: "hello" } } as never);
    recorder.addTelemetry({ ...sample(20, 4), at_ms: 1_004_150 });
    recorder.stop();
    recorder.addTelemetry(sample(5000, 9));
    const recording = recorder.recording.value;
    expect(recording.samples.map(({ time_s }) => Number(time_s.toFixed(2)))).toEqual([0, 0.05, 0.1, 2.1, 2.15, 3.15]);
    expect(recording.gaps.map(({ from_s, to_s }) => [from_s.toFixed(2), to_s.toFixed(2)])).toEqual([["0.10", "2.10"], ["2.15", "3.15"]]);
    expect(recording.speech[0]?.time_s).toBeCloseTo(2.15);
    expect(trim(recording, 2, 9).gaps).toHaveLength(1);
    const keyframes = keyframesOf(trim(recording, 2, 9), 0.01, robot);
    expect(keyframes[0]?.time_s).toBe(0);
    expect(keyframes.some(({ say }) => say === "hello")).toBe(true);
  });

  test("is reduced to few keyframes within a tolerance", () => {
    const samples: Sample[] = Array.from({ length: 101 }, (_, index) => {
      const time_s = index / 20;
      return { time_s, position_rad: [Math.min(time_s, 5 - time_s) / 5, 0.3, 0, 0] };
    });
    expect(simplify(samples, 0.01, new Set())).toEqual([0, 50, 100]);
    const keyframes = keyframesOf({ samples, gaps: [], speech: [] }, 0.01, robot);
    expect(times(movement(...keyframes))).toEqual([0, 2.5, 5]);
    expect(keyframes.slice(0, 2).map(({ position_rad }) => position_rad)).toEqual([{ yaw: 0, pitch: 0.3, left: 0 }, { yaw: 0.5 }]);
    expect(problems(movement(...keyframes), robot)).toEqual([]);
    const wobbly = samples.map((each, index) => ({ ...each, position_rad: [Math.sin(index / 8), 0, 0, 0] }));
    const count = (tolerance: number): number => simplify(wobbly, tolerance, new Set()).length;
    expect(count(0.1)).toBeLessThan(count(0.01));
    expect(keyframesOf({ samples: [], gaps: [], speech: [] }, 0.01, robot)).toEqual([]);
  });
});
