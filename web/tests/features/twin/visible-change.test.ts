import { expect, it } from "vitest";
import { isVisibleChange } from "../../../src/features/twin/model/visible-change";

const LEVER_M = 2;
const PX_PER_M = 100;

it("draws what moves a part by half a pixel, however many joints share it", () => {
  const drawn = { shoulder: 0.1, elbow: 0.2 };
  expect(isVisibleChange(drawn, { shoulder: 0.1, elbow: 0.2 }, LEVER_M, PX_PER_M)).toBe(false);
  expect(isVisibleChange(drawn, { shoulder: 0.102, elbow: 0.2 }, LEVER_M, PX_PER_M)).toBe(false);
  expect(isVisibleChange(drawn, { shoulder: 0.102, elbow: 0.198 }, LEVER_M, PX_PER_M)).toBe(true);
  expect(isVisibleChange(drawn, { shoulder: 0.103, elbow: 0.2 }, LEVER_M, PX_PER_M)).toBe(true);
  expect(isVisibleChange(drawn, { shoulder: 0.102, elbow: 0.2 }, LEVER_M, 2 * PX_PER_M)).toBe(true);
});

it("draws a ghost that comes or goes, and a joint that the picture does not know", () => {
  expect(isVisibleChange(null, { shoulder: 0 }, LEVER_M, PX_PER_M)).toBe(true);
  expect(isVisibleChange({ shoulder: 0 }, null, LEVER_M, PX_PER_M)).toBe(true);
  expect(isVisibleChange(null, null, LEVER_M, PX_PER_M)).toBe(false);
  expect(isVisibleChange({}, { shoulder: 0 }, LEVER_M, PX_PER_M)).toBe(true);
});
