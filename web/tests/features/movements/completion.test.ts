import { readFileSync } from "node:fs";
import { CompletionContext } from "@codemirror/autocomplete";
import { python } from "@codemirror/lang-python";
import { ensureSyntaxTree } from "@codemirror/language";
import { EditorState } from "@codemirror/state";
import { describe, expect, test } from "vitest";
import type { Scripting } from "../../../src/shared/api/movement-library";
import { complete } from "../../../src/features/movements/completion";

const api = JSON.parse(
  readFileSync(new URL("../../../../device_agent/protocol/documents/script_api.json", import.meta.url), "utf8"),
) as Scripting["api"];
const scripting: Scripting = { api, names: { joints: ["elbow", "wrist_1"], frames: ["flange"], postures: ["Stand"] } };

/** The completions at the bar in the text. */
function offered(text: string, explicit = false): string[] {
  const pos = text.indexOf("|");
  const state = EditorState.create({ doc: text.replace("|", ""), extensions: [python()] });
  ensureSyntaxTree(state, state.doc.length, 10_000); // By default the parser stops after 20 ms.
  const found = complete(scripting, new CompletionContext(state.update({}).state, pos, explicit), ["speed", "times"]);
  return (found?.options ?? []).map(({ label }) => label);
}

describe("completion", () => {
  test("offers members, names, functions and modules", () => {
    expect(offered("robot.|")).toEqual(expect.arrayContaining(["move_joints", "home", "say", "joints", "can"]));
    expect(offered("x = 1\nroom.la|")).toEqual(["latest", "taken"]);
    expect(offered("other.|")).toEqual([]);
    expect(offered("wa|")).toEqual(expect.arrayContaining(["wait", "progress", "print", "robot", "parameters", "RobotError"]));
    expect(offered("import ma|")).toContain("math");
    expect(offered("from |")).toContain("itertools");
  });

  test.each([
    ["robot.move_joints({'|': 1})", ["elbow", "wrist_1"]],
    ["robot.move_joints({'elbow': 1, 'wr|'})", ["elbow", "wrist_1"]],
    ['robot.stiffness(0.5, ["|"])', ["elbow", "wrist_1"]],
    ["robot.move_to([0, 0, 1], frame='|')", ["flange"]],
    ["robot.posture('S|", ["Stand"]],
    ["robot.say('|')", []],
    ["robot.move_joints(5, '|')", []],
    ["parameters['|']", ["speed", "times"]],
    ["parameters.get('|')", ["speed", "times"]],
    ["x = '|'", []],
    ["# robot.|", []],
  ])("offers names inside strings: %s", (text, expected) => {
    expect(offered(text)).toEqual(expected);
  });

  test("offers a call's arguments by name first, and nothing at an empty position without an explicit request", () => {
    expect(offered("robot.home(s|)")[0]).toBe("speed");
    expect(offered("robot.drive(|)", true).slice(0, 4)).toEqual(["forward_m_s", "left_m_s", "turn_rad_s", "duration_s"]);
    expect(offered("|")).toEqual([]);
    expect(offered("|", true)).toContain("robot");
  });
});
