/** Key map for steering. Codes name physical positions, so that the layout is the same on every keyboard. */
import { AT_REST, direction, type Direction, type Push } from "./steerable-parts";

const push = (part: Partial<Push>): Push => ({ ...AT_REST, ...part });

export const DRIVE_KEYS: Readonly<Record<string, Push>> = {
  KeyW: push({ forward: 1 }),
  ArrowUp: push({ forward: 1 }),
  KeyS: push({ forward: -1 }),
  ArrowDown: push({ forward: -1 }),
  KeyA: push({ turn: 1 }),
  ArrowLeft: push({ turn: 1 }),
  KeyD: push({ turn: -1 }),
  ArrowRight: push({ turn: -1 }),
  KeyQ: push({ left: 1 }),
  KeyE: push({ left: -1 }),
};

export const JOG_KEYS: Readonly<Record<string, Direction>> = {
  KeyW: direction("along", 0, 1),
  KeyS: direction("along", 0, -1),
  KeyA: direction("along", 1, 1),
  KeyD: direction("along", 1, -1),
  KeyR: direction("along", 2, 1),
  KeyF: direction("along", 2, -1),
  KeyO: direction("about", 0, 1),
  KeyU: direction("about", 0, -1),
  KeyI: direction("about", 1, 1),
  KeyK: direction("about", 1, -1),
  KeyJ: direction("about", 2, 1),
  KeyL: direction("about", 2, -1),
};

/** Direction of the selected joint. */
export const JOINT_KEYS: Readonly<Record<string, 1 | -1>> = { ArrowUp: 1, ArrowRight: 1, ArrowDown: -1, ArrowLeft: -1 };

/** The joint index of a number key: 1 is the first joint, 0 the tenth. `null`: not a number key. */
export function jointOfKey(code: string): number | null {
  const digit = /^(?:Digit|Numpad)([0-9])$/.exec(code)?.[1];
  if (digit === undefined) return null;
  return digit === "0" ? 9 : Number(digit) - 1;
}
