/** Places the labels of moving marks on a plan without overlap [px]. */

export interface Box {
  left: number;
  top: number;
  width: number;
  height: number;
}

/** The centre of a mark and the size of its label. */
export interface LabelledMark {
  x: number;
  y: number;
  width: number;
  height: number;
}

export interface Placed {
  left: number;
  top: number;
  /** The index of the position around the mark; passing it again keeps the label in place. */
  place: number;
  /** The line from the mark to the label; `null` if they are adjacent. */
  leader: { length: number; angleRad: number } | null;
}

/** Half a mark plus a margin. */
const MARK_DISTANCE = 15;
/** Distances from the mark. */
const STEPS = [0, 20, 40, 60, 85];
const MIN_GAP = 2;
/** Below first. */
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
 * Greedy: each label takes the nearest free position around its mark, or `null`. `before`: the previous positions,
 * tried first, so that labels stay in place.
 */
export function placeLabels(
  marks: readonly LabelledMark[],
  taken: readonly Box[],
  within: { width: number; height: number },
  before: readonly (number | undefined)[] = [],
): (Placed | null)[] {
  const occupied = [...taken];
  return marks.map((mark, index) => {
    const last = before[index];
    const around = STEPS.flatMap((_, step) => SIDES.map((_, side) => step * SIDES.length + side));
    for (const place of last === undefined ? around : [last, ...around]) {
      const box = boxAt(mark, place);
      if (!inside(box, within) || occupied.some((other) => overlap(box, other))) continue;
      occupied.push(box);
      const leader = place < SIDES.length ? null : leaderTo(mark, box);
      return { left: box.left, top: box.top, place, leader };
    }
    return null;
  });
}

function boxAt({ x, y, width, height }: LabelledMark, place: number): Box {
  const [sideX, sideY] = SIDES[place % SIDES.length] ?? SIDES[0];
  const off = MARK_DISTANCE + (STEPS[Math.floor(place / SIDES.length)] ?? 0);
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
    one.left < other.left + other.width + MIN_GAP &&
    other.left < one.left + one.width + MIN_GAP &&
    one.top < other.top + other.height + MIN_GAP &&
    other.top < one.top + one.height + MIN_GAP
  );
}

function leaderTo({ x, y }: LabelledMark, { left, top, width, height }: Box): { length: number; angleRad: number } {
  const [toX, toY] = [Math.min(left + width, Math.max(left, x)) - x, Math.min(top + height, Math.max(top, y)) - y];
  return { length: Math.hypot(toX, toY), angleRad: Math.atan2(toY, toX) };
}
