/** Where the names of what moves on a plan stand, so that none covers another, or anything that is marked there [px]. */

export interface Box {
  left: number;
  top: number;
  width: number;
  height: number;
}

/** The middle of a mark, and how large its name is. */
export interface Named {
  x: number;
  y: number;
  width: number;
  height: number;
}

export interface Placed {
  left: number;
  top: number;
  /** Which of the places around the mark it is: given again, it stays there as long as it can. */
  place: number;
  /** From the mark to the nearest point of the name where something may stand between, `null` beside it. */
  leader: { length: number; angleRad: number } | null;
}

/** Half a mark and a little air. */
const BESIDE = 15;
/** How far off a name may go, from beside its mark on. */
const STEPS = [0, 20, 40, 60, 85];
const AIR = 2;
/** Below first, where one looks for it. */
const SIDES = [
  [0, 1],
  [0, -1],
  [1, 0],
  [-1, 0],
  [1, 1],
  [-1, 1],
  [1, -1],
  [-1, -1],
] as const;

/**
 * Greedy: each name in turn takes the nearest place around its mark that is free. `null` where none is: it has to be told
 * elsewhere. `before`: which place each had last, tried first, so that names do not jump about while things move.
 */
export function placeLabels(
  marks: readonly Named[],
  taken: readonly Box[],
  within: { width: number; height: number },
  before: readonly (number | undefined)[] = [],
): (Placed | null)[] {
  const full = [...taken];
  return marks.map((mark, index) => {
    const last = before[index];
    const around = STEPS.flatMap((_, step) => SIDES.map((_, side) => step * SIDES.length + side));
    for (const place of last === undefined ? around : [last, ...around]) {
      const box = boxAt(mark, place);
      if (!inside(box, within) || full.some((other) => overlap(box, other))) continue;
      full.push(box);
      const leader = place < SIDES.length ? null : leaderTo(mark, box);
      return { left: box.left, top: box.top, place, leader };
    }
    return null;
  });
}

function boxAt({ x, y, width, height }: Named, place: number): Box {
  const [sideX, sideY] = SIDES[place % SIDES.length] ?? SIDES[0];
  const off = BESIDE + (STEPS[Math.floor(place / SIDES.length)] ?? 0);
  return {
    left: x - width / 2 + sideX * (width / 2 + off),
    top: y - height / 2 + sideY * (height / 2 + off),
    width,
    height,
  };
}

function inside({ left, top, width, height }: Box, within: { width: number; height: number }): boolean {
  return left >= 0 && top >= 0 && left + width <= within.width && top + height <= within.height;
}

function overlap(one: Box, other: Box): boolean {
  return (
    one.left < other.left + other.width + AIR &&
    other.left < one.left + one.width + AIR &&
    one.top < other.top + other.height + AIR &&
    other.top < one.top + one.height + AIR
  );
}

function leaderTo({ x, y }: Named, { left, top, width, height }: Box): { length: number; angleRad: number } {
  const [toX, toY] = [Math.min(left + width, Math.max(left, x)) - x, Math.min(top + height, Math.max(top, y)) - y];
  return { length: Math.hypot(toX, toY), angleRad: Math.atan2(toY, toX) };
}
