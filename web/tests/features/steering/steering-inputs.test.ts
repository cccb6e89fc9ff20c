import { describe, expect, it } from "vitest";
import { DEAD_ZONE, readPad, type Pad } from "../../../src/features/steering/model/gamepad-mapping";
import { PressedInputs } from "../../../src/features/steering/model/pressed-inputs";
import { DRIVE_KEYS, JOG_KEYS, jointOfKey } from "../../../src/features/steering/model/keymap";
import type { KnownDescription } from "../../../src/shared/mqtt/parse-messages";
import { direction, driveOf, jogOf, pushed, restOf, sumOf, steeringModesOf } from "../../../src/features/steering/model/steerable-parts";
import { description } from "../../support/arm";

const LIMITS = { forward_m_s: 0.3, left_m_s: 0, turn_rad_s: 1.5 };
const known = description as unknown as KnownDescription;

describe("the ways to steer", () => {
  it("are those that the description names", () => {
    expect(steeringModesOf(null)).toEqual([]);
    expect(steeringModesOf({ ...known, actions: [], base: null })).toEqual(["joints"]);
    expect(steeringModesOf({ ...known, actions: ["move_pose"], base: LIMITS })).toEqual(["joints", "jog", "drive"]);
    expect(steeringModesOf({ ...known, actions: ["move_pose"], frames: [], base: null })).toEqual(["joints"]);
    expect(steeringModesOf({ ...known, joints: [], actions: [], base: null })).toEqual([]);
  });

  it("never ask a base for more than it can do", () => {
    const all = pushed([DRIVE_KEYS["KeyW"], DRIVE_KEYS["ArrowUp"], DRIVE_KEYS["KeyA"]].filter((one) => one !== undefined));
    expect(driveOf(all, LIMITS, 1)).toEqual({ kind: "drive", forward_m_s: 0.3, left_m_s: 0, turn_rad_s: 1.5 });
    expect(driveOf({ forward: 5, left: 5, turn: -5 }, LIMITS, 0.5)).toMatchObject({ forward_m_s: 0.15, left_m_s: 0, turn_rad_s: -0.75 });
    expect(driveOf({ forward: 1, left: 0, turn: 0 }, LIMITS, 9).forward_m_s).toBe(0.3);
  });

  it("move a frame as fast along two axes as along one, and nowhere when opposite pads are held", () => {
    const speed = { linear_m_s: 0.1, angular_rad_s: 0.2 };
    const jog = jogOf(sumOf([direction("along", 0, 1), direction("along", 2, -1), direction("about", 1, 1)]), speed, "tool0", true);
    expect(Math.hypot(...(jog.linear_m_s ?? []))).toBeCloseTo(0.1);
    expect(jog).toMatchObject({ angular_rad_s: [0, 0.2, 0], frame: "tool0", tool: true });
    expect(jogOf(sumOf([direction("along", 0, 1), direction("along", 0, -1)]), speed, "", false).linear_m_s).toEqual([0, 0, 0]);
    expect(restOf(jog)).toEqual({ ...jog, linear_m_s: [0, 0, 0], angular_rad_s: [0, 0, 0] });
  });

  it("have a key for each direction, and no key for two of them", () => {
    const directions = Object.values(JOG_KEYS).map((one) => JSON.stringify(one));
    expect(new Set(directions).size).toBe(12);
    expect(["Digit1", "Numpad9", "Digit0", "KeyA"].map(jointOfKey)).toEqual([0, 8, 9, null]);
  });
});

describe("what is held", () => {
  const made = (): [PressedInputs<number>, (readonly number[])[]] => {
    const told: (readonly number[])[] = [];
    return [new PressedInputs<number>((parts) => told.push(parts)), told];
  };

  it("is the sum of all that is pressed, and nothing when the last is let go", () => {
    const [held, told] = made();
    held.press("w", 1);
    held.press("a", 2);
    held.release("w");
    held.release("a");
    held.release("a");
    expect(told).toEqual([[1], [1, 2], [2], []]);
  });

  it("counts for nothing once it is spent, until it is pressed anew", () => {
    const [held, told] = made();
    held.press("pad", 1);
    held.spend();
    held.keep("pad", 2);
    held.keep("pad", 3);
    expect(told).toEqual([[1]]);
    held.release("pad");
    held.keep("pad", 4);
    expect(told.at(-1)).toEqual([4]);
    held.spend();
    held.press("pad", 5);
    expect(told.at(-1)).toEqual([5]);
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

  it("has sticks whose middle is nothing and whose edge is everything", () => {
    const near = readPad(pad([DEAD_ZONE * 0.6, DEAD_ZONE * 0.6, 0, 0]));
    expect(near?.left).toEqual([0, 0]);
    const far = readPad(pad([0, -1, 1, 1]));
    expect(far?.left[1]).toBeCloseTo(1);
    expect(Math.hypot(...(far?.right ?? []))).toBeCloseTo(1);
    const just = readPad(pad([DEAD_ZONE + 0.01, 0, 0, 0]));
    expect(just?.left[0]).toBeGreaterThan(0);
    expect(just?.left[0]).toBeLessThan(0.02);
  });

  it("holds by either shoulder, lifts by its triggers, and stops by its button", () => {
    expect(readPad(pad([0, 0, 0, 0]))).toMatchObject({ held: false, stop: false, lift: 0, cross: [0, 0] });
    expect(readPad(pad([0, 0, 0, 0], { 4: 1 }))?.held).toBe(true);
    expect(readPad(pad([0, 0, 0, 0], { 5: 1, 7: 1 }))).toMatchObject({ held: true, lift: 1 });
    expect(readPad(pad([0, 0, 0, 0], { 6: 0.5, 1: 1, 12: 1, 14: 1 }))).toMatchObject({ stop: true, lift: -0.5, cross: [-1, 1] });
  });

  it("is not read if its button layout is unknown", () => {
    expect(readPad(pad([0, 0, 0, 0], {}, { mapping: "" }))).toBeNull();
    expect(readPad(pad([], {}, { connected: false }))).toBeNull();
    expect(readPad(null)).toBeNull();
    expect(readPad(pad([NaN, 0], {}, { buttons: [] }))).toMatchObject({ held: false, left: [0, 0] });
  });
});
