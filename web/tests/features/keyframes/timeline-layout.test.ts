import { plan } from "../../../src/features/keyframes/model/plan";
import { readFileSync } from "node:fs";
import { expect, test } from "vitest";
import { type Movement, type Robot } from "../../../src/features/keyframes/model/keyframes";
import { Curve } from "../../../src/features/keyframes/model/timeline-layout";
import { head } from "../../support/robots";

interface Case {
  name: string;
  start_rad: number[];
  keyframes: Movement["keyframes"];
  expected: { reached_s: number[]; position_rad: number[][] };
}

const cases = JSON.parse(readFileSync(new URL("../../../../tests/unit/device_agent/runtime/planning/timelines.json", import.meta.url), "utf8")) as Case[];

/** The start pose of the robot is the first keyframe of the plan. */
function movement({ start_rad, keyframes }: Case, robot: Robot): Movement {
  const start = Object.fromEntries(robot.joints.map(({ name }, index) => [name, start_rad[index] ?? 0]));
  delete start["right"];
  const uncoupled = keyframes.map(({ time_s, position_rad: { right, ...others } }) => ({
    time_s,
    position_rad: { ...others, ...(right === undefined ? {} : { left: right / -0.5 }) },
  }));
  return { description: "", keyframes: [{ time_s: 0, position_rad: start }, ...uncoupled] };
}

test.each(cases)("$name: the plan equals the trajectory of the robot", (one) => {
  const robot = head();
  const found = plan(movement(one, robot), robot);
  one.expected.reached_s.forEach((time, index) => expect(found.reached_s[index + 1]).toBeCloseTo(time, 5));
  one.expected.position_rad.forEach((places, index) => {
    const now = found.at((found.duration_s * index) / 9);
    // The robot's control periods are coarser where a narrow range begins.
    robot.joints.forEach(({ name }, joint) => expect(now[name], `${name} at sample ${index}`).toBeCloseTo(places[joint] ?? NaN, 2.5));
  });
});

test("a curve continues through monotonic keyframes, rests at turning points and does not overshoot", () => {
  const curve = new Curve([0, 1, 3, 4], [0, 1, 2, 1.5]);
  const speed = (time: number): number => (curve.at(time + 1e-5) - curve.at(time - 1e-5)) / 2e-5;
  expect(speed(1)).toBeCloseTo((2 * 1 * 0.5) / 1.5, 3);
  expect(speed(3)).toBeCloseTo(0, 3);
  for (let time = -1; time < 5; time += 0.01) expect(curve.at(time)).toBeLessThanOrEqual(2);
});
