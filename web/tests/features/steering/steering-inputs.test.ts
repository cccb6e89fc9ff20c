import { describe, expect, it } from "vitest";
import { DEAD_ZONE, readPad, type Pad } from "../../../src/features/steering/model/gamepad-mapping";
import { PressedInputs } from "../../../src/features/steering/model/pressed-inputs";
import { DRIVE_KEYS, JOG_KEYS, jointOfKey } from "../../../src/features/steering/model/keymap";
import { direction, driveOf, jogOf, sumOfPushes, zeroOf, sumOf, steeringModesOf } from "../../../src/features/steering/model/steerable-parts";
import { readDescription } from "../../../src/shared/mqtt/parse-messages";
import { bytes, description } from "../../support/messages";

const LIMITS = { forward_m_s: 0.3, left_m_s: 0, turn_rad_s: 1.5 };
const known = readDescription(bytes(description));

describe("steering modes", () => {
  it("are those that the description names", () => {
    expect(steeringModesOf(null)).toEqual([]);
    expect(steeringModesOf({ ...known, actions: [], base: null })).toEqual(["joints"]);
    expect(steeringModesOf({ ...known, actions: ["move_pose"], base: LIMITS })).toEqual(["joints", "jog", "drive"]);
    expect(steeringModesOf({ ...known, actions: ["move_pose"], frames: [], base: null })).toEqual(["joints"]);
    expect(steeringModesOf({ ...known, joints: [], actions: [], base: null })).toEqual([]);
  });

  it("keep a base within its limits", () => {
    const all = sumOfPushes([DRIVE_KEYS["KeyW"], DRIVE_KEYS["ArrowUp"], DRIVE_KEYS["KeyA"]].filter((part) => part !== undefined));
    expect(driveOf(all, LIMITS, 1)).toEqual({ kind: "drive", forward_m_s: 0.3, left_m_s: 0, turn_rad_s: 1.5 });
    expect(driveOf({ forward: 5, left: 5, turn: -5 }, LIMITS, 0.5)).toMatchObject({ forward_m_s: 0.15, left_m_s: 0, turn_rad_s: -0.75 });
    expect(driveOf({ forward: 1, left: 0, turn: 0 }, LIMITS, 9).forward_m_s).toBe(0.3);
  });

  it("move a frame at one speed in every direction, and not at all for opposite directions", () => {
    const speed = { linear_m_s: 0.1, angular_rad_s: 0.2 };
    const jog = jogOf(sumOf([direction("along", 0, 1), direction("along", 2, -1), direction("about", 1, 1)]), speed, "tool0", true);
    expect(Math.hypot(...(jog.linear_m_s ?? []))).toBeCloseTo(0.1);
    expect(jog).toMatchObject({ angular_rad_s: [0, 0.2, 0], frame: "tool0", tool: true });
    expect(jogOf(sumOf([direction("along", 0, 1), direction("along", 0, -1)]), speed, "", false).linear_m_s).toEqual([0, 0, 0]);
    expect(zeroOf(jog)).toEqual({ ...jog, linear_m_s: [0, 0, 0], angular_rad_s: [0, 0, 0] });
  });

  it("have one key for each direction", () => {
    expect(new Set(Object.values(JOG_KEYS).map((each) => JSON.stringify(each))).size).toBe(12);
    expect(["Digit1", "Numpad9", "Digit0", "KeyA"].map(jointOfKey)).toEqual([0, 8, 9, null]);
  });
});

describe("pressed inputs", () => {
  it("are reported together after each change, and not again after they are spent, until a new press", () => {
    const reports: (readonly number[])[] = [];
    const inputs = new PressedInputs<number>((parts) => reports.push(parts));
    inputs.press("w", 1);
    inputs.press("a", 2);
    inputs.release("w");
    inputs.release("a");
    inputs.release("a");
    expect(reports.splice(0)).toEqual([[1], [1, 2], [2], []]);
    inputs.press("pad", 1);
    inputs.spend();
    inputs.update("pad", 2);
    expect(reports).toEqual([[1]]);
    inputs.release("pad");
    inputs.update("pad", 4);
    expect(reports.at(-1)).toEqual([4]);
    inputs.spend();
    inputs.press("pad", 5);
    expect(reports.at(-1)).toEqual([5]);
  });
});

describe("a gamepad", () => {
  const pad = (axes: number[], buttons: Record<number, number> = {}, rest: Partial<Pad> = {}): Pad => ({
    id: "pad",
    index: 0,
    connected: true,
    mapping: "standard",
    axes,
    buttons: Array.from({ length: 17 }, (_, index) => ({ pressed: (buttons[index] ?? 0) > 0.5, value: buttons[index] ?? 0 })),
    ...rest,
  });

  it("has sticks with a dead zone and a full deflection at the edge", () => {
    expect(readPad(pad([DEAD_ZONE * 0.6, DEAD_ZONE * 0.6, 0, 0]))?.left).toEqual([0, 0]);
    const full = readPad(pad([0, -1, 1, 1]));
    expect(full?.left[1]).toBeCloseTo(1);
    expect(Math.hypot(...(full?.right ?? []))).toBeCloseTo(1);
    const [slight = NaN] = readPad(pad([DEAD_ZONE + 0.01, 0, 0, 0]))?.left ?? [];
    expect(slight > 0 && slight < 0.02).toBe(true);
  });

  it("has shoulder buttons as dead-man's switches, triggers to lift, and a stop button", () => {
    expect(readPad(pad([0, 0, 0, 0]))).toMatchObject({ enabled: false, stop: false, lift: 0, cross: [0, 0] });
    expect(readPad(pad([0, 0, 0, 0], { 4: 1 }))?.enabled).toBe(true);
    expect(readPad(pad([0, 0, 0, 0], { 5: 1, 7: 1 }))).toMatchObject({ enabled: true, lift: 1 });
    expect(readPad(pad([0, 0, 0, 0], { 6: 0.5, 1: 1, 12: 1, 14: 1 }))).toMatchObject({ stop: true, lift: -0.5, cross: [-1, 1] });
  });

  it("is not read with an unknown layout or disconnected, and invalid values count as zero", () => {
    expect(readPad(pad([0, 0, 0, 0], {}, { mapping: "" }))).toBeNull();
    expect(readPad(pad([], {}, { connected: false }))).toBeNull();
    expect(readPad(null)).toBeNull();
    expect(readPad(pad([NaN, 0], {}, { buttons: [] }))).toMatchObject({ enabled: false, left: [0, 0] });
  });
});
