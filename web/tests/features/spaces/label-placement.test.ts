import { describe, expect, it } from "vitest";
import { type Box, type LabelledMark, placeLabels } from "../../../src/features/spaces/model/label-placement";

const ROOM = { width: 360, height: 300 };
const named = (x: number, y: number, width = 90): LabelledMark => ({ x, y, width, height: 18 });
const pin = (x: number, y: number): Box => ({ left: x - 12, top: y - 12, width: 24, height: 24 });

function apart(boxes: readonly Box[]): boolean {
  return boxes.every((one, index) =>
    boxes
      .slice(0, index)
      .every(
        (other) =>
          one.left >= other.left + other.width ||
          other.left >= one.left + one.width ||
          one.top >= other.top + other.height ||
          other.top >= one.top + one.height,
      ),
  );
}

function boxes(marks: readonly LabelledMark[], taken: readonly Box[], before?: readonly (number | undefined)[]): Box[] {
  return placeLabels(marks, taken, ROOM, before).flatMap((placed, index) => {
    const { width, height } = marks[index] ?? named(0, 0);
    return placed === null ? [] : [{ left: placed.left, top: placed.top, width, height }];
  });
}

describe("labels on a plan", () => {
  it("are below their marks if that place is free", () => {
    const [placed] = placeLabels([named(180, 100)], [], ROOM);
    expect(placed).toMatchObject({ left: 135, top: 115, leader: null });
  });

  it("overlap neither pins nor each other", () => {
    const taken = [pin(60, 40), pin(85, 40), pin(60, 65), pin(85, 65), pin(110, 40), pin(300, 270)];
    const marks = [named(60, 60, 120), named(75, 50, 100), named(90, 70, 110), named(350, 290)];
    const found = boxes(marks, taken);
    expect(found).toHaveLength(4);
    for (const box of found) {
      for (const each of taken) expect(apart([box, each])).toBe(true);
      expect(box.left >= 0 && box.top >= 0 && box.left + box.width <= 360 && box.top + box.height <= 300).toBe(true);
    }
    expect(apart(found)).toBe(true);
  });

  it("have a leader line that ends at the label, if they are not adjacent to their mark", () => {
    const wall = [-12, 12, 36].flatMap((y) => [140, 165, 190, 215].map((x) => pin(x, 100 + y)));
    const [placed] = placeLabels([named(180, 110)], wall, ROOM);
    const { left = NaN, top = NaN, leader = null } = placed ?? {};
    expect(leader).not.toBeNull();
    const { length, angleRad } = leader ?? { length: NaN, angleRad: NaN };
    const end: Box = { left: 180 + length * Math.cos(angleRad), top: 110 + length * Math.sin(angleRad), width: 0, height: 0 };
    expect(apart([end, { left: left - 0.01, top: top - 0.01, width: 90.02, height: 18.02 }])).toBe(false);
  });

  it("are listed separately if no position is free", () => {
    expect(placeLabels([named(180, 100, 400)], [], ROOM)).toEqual([null]);
  });

  it("stay in place while the place is free", () => {
    const above = placeLabels([named(180, 100)], [pin(180, 125)], ROOM)[0]?.place;
    expect(above).toBe(1);
    expect(placeLabels([named(180, 100)], [], ROOM, [above])[0]?.place).toBe(above);
    expect(placeLabels([named(180, 100)], [pin(180, 75)], ROOM, [above])[0]?.place).toBe(0);
  });
});
