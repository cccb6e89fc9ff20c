import { describe, expect, it } from "vitest";
import { forward, jointFrames, multiply, placementOf, rollPitchYaw, rotate, jointPosition } from "../../../src/features/twin/model/forward-kinematics";
import type { Quaternion } from "../../../src/shared/lib/vectors";
import { readTwin, type KnownBody } from "../../../src/shared/mqtt/parse-messages";
import fixture from "../../fixtures/ur5.json";
import { twin as ur5 } from "../../support/messages";

const twin = readTwin(new TextEncoder().encode(JSON.stringify(ur5)));
const HALF = Math.SQRT1_2;

function body(joint: Partial<KnownBody["joint"]>, rest: Partial<KnownBody> = {}): KnownBody {
  return {
    name: "b",
    parent: -1,
    position_m: [0, 0, 0],
    quaternion: [1, 0, 0, 0],
    joint: { name: "j", kind: "hinge", axis: [0, 0, 1], anchor_m: [0, 0, 0], reference_rad: 0, follows: {}, ...joint },
    geometries: [],
    ...rest,
  };
}

function near(found: readonly number[], expected: readonly number[], digits = 9): void {
  expect(found).toHaveLength(expected.length);
  found.forEach((value, index) => expect(value).toBeCloseTo(expected[index] ?? NaN, digits));
}

describe("forward kinematics of a twin", () => {
  it("computes the same pose as MuJoCo for every body of the UR5", () => {
    expect(fixture.poses.length).toBeGreaterThan(9);
    for (const { position_rad, bodies } of fixture.poses) {
      const found = forward(twin, position_rad);
      const named = Object.entries(bodies as Record<string, number[]>);
      expect(named.length).toBeGreaterThan(6);
      for (const [name, expected] of named) {
        const placement = found[twin.bodies.findIndex((one) => one.name === name)];
        if (placement === undefined) throw new Error(`the twin has no body ${name}`);
        near(placement.position_m, expected.slice(0, 3), 6);
        // q and -q are the same rotation.
        const dot = placement.quaternion.reduce((sum, part, index) => sum + part * (expected[3 + index] ?? 0), 0);
        expect(Math.abs(dot)).toBeCloseTo(1, 9);
      }
    }
  });

  it("rotates a body about its joint's anchor, which stays in place", () => {
    const only = body({ anchor_m: [1, 0, 0] });
    for (const position of [0, 1, 2]) near(jointFrames({ device: "d", bodies: [only] }, { j: position })[0]?.position_m ?? [], [1, 0, 0]);
    const { position_m, quaternion } = placementOf(only, Math.PI / 2);
    near(position_m, [1, -1, 0]);
    near(quaternion, [HALF, 0, 0, HALF]);
  });

  it("measures a joint from its reference, about an axis of any length", () => {
    const { quaternion } = placementOf(body({ reference_rad: 0.5, axis: [0, 0, 3] }), 0.5 + Math.PI / 2);
    near(quaternion, [HALF, 0, 0, HALF]);
  });

  it("slides along its axis in the body's own frame", () => {
    const turned = body({ kind: "slide", axis: [2, 0, 0] }, { quaternion: [HALF, 0, 0, HALF], position_m: [0, 0, 1] });
    near(placementOf(turned, 0.25).position_m, [0, 0.25, 1]);
  });

  it("couples a passive joint to the joints that it follows", () => {
    const { joint } = body({ follows: { left: 0.25, right: -0.5 } });
    expect(jointPosition(joint, { left: 1, right: 2, j: 9 })).toBeCloseTo(-0.75, 12);
    expect(jointPosition(joint, { left: 1 })).toBeCloseTo(0.25, 12);
  });

});

describe("roll, pitch and yaw", () => {
  const about = (axis: 1 | 2 | 3, angle: number): Quaternion => {
    const q: Quaternion = [Math.cos(angle / 2), 0, 0, 0];
    q[axis] = Math.sin(angle / 2);
    return q;
  };

  it.each([1, 2, 3] as const)("are those of a quarter turn about axis %s", (axis) => {
    near(rollPitchYaw(about(axis, Math.PI / 2)), [1, 2, 3].map((each) => (each === axis ? Math.PI / 2 : 0)), 6);
  });

  it("describe the same rotation, also where roll and yaw share an axis", () => {
    const turns = [-3, -Math.PI / 2, -0.4, 0, 1, Math.PI / 2, 2.5];
    const angles = turns.flatMap((yaw) => [-Math.PI / 2, -0.7, 0, 0.3, Math.PI / 2].flatMap((pitch) => turns.map((roll) => [roll, pitch, yaw] as const)));
    const rotation = ([roll, pitch, yaw]: readonly [number, number, number]): Quaternion =>
      multiply(multiply(about(3, yaw), about(2, pitch)), about(1, roll));
    for (const each of angles) {
      const q = rotation(each);
      const again = rotation(rollPitchYaw(q));
      expect(Math.abs(q.reduce((sum, part, index) => sum + part * (again[index] ?? 0), 0))).toBeCloseTo(1, 8);
    }
  });

  it("rotate a vector", () => {
    near(rotate([0.5, 0.5, -0.5, 0.5], [1, 0, 0]), [0, 0, 1]);
  });
});
