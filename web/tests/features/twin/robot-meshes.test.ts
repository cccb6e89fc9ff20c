import { MeshBasicMaterial, Vector3 } from "three";
import { describe, expect, it } from "vitest";
import { RobotMeshes } from "../../../src/features/twin/robot-meshes";
import { forward, rotate, add } from "../../../src/features/twin/model/forward-kinematics";
import type { KnownTwin } from "../../../src/shared/mqtt/parse-messages";

type Body = KnownTwin["bodies"][number];

const HALF = Math.SQRT1_2;
const sphere = (x: number, rgba: [number, number, number, number] = [1, 0, 0, 1]): Body["geometries"][number] => ({
  shape: "sphere", size_m: [0.01, 0, 0], position_m: [x, 0, 0], quaternion: [1, 0, 0, 0], rgba,
});
const body = (parent: number, joint: string | null, geometries: Body["geometries"]): Body =>
  ({
    parent, position_m: [0.5, 0.1, 0.2], quaternion: [HALF, 0, HALF, 0], geometries,
    joint: joint === null ? null : { name: joint, kind: "hinge", axis: [0, 0, 1], anchor_m: [0.02, 0, 0], reference_rad: 0 },
  }) as Body;

/** A base, a joint, a fixed bracket on it, and a joint on the bracket. */
const TWIN = {
  bodies: [
    body(-1, null, [sphere(0), { ...sphere(0), shape: "plane" }]),
    body(0, "yaw", [sphere(0.1), sphere(0.2)]),
    body(1, null, [sphere(0.3), sphere(0.3, [0, 1, 0, 0.5])]),
    body(2, "pitch", [sphere(0.4)]),
  ],
} as KnownTwin;

const meshes = (fixed: boolean): RobotMeshes => new RobotMeshes(TWIN, () => new MeshBasicMaterial(), { fixed });

describe("the meshes of a robot", () => {
  it("are one for each moving body and opacity, with the fixed parts in the body that carries them", () => {
    expect(meshes(true).meshes.length).toBe(4);
    expect(meshes(false).meshes.length).toBe(3);
  });

  it("are where the forward kinematics has their parts", () => {
    const pose = { yaw: 0.7, pitch: -0.4 };
    const robot = meshes(true);
    robot.pose(pose);
    robot.root.updateMatrixWorld(true);
    const centres = robot.meshes.map((mesh) => {
      mesh.geometry.computeBoundingBox();
      return mesh.geometry.boundingBox?.getCenter(new Vector3()).applyMatrix4(mesh.matrixWorld) ?? new Vector3();
    });
    const placements = forward(TWIN, pose);
    const place = (index: number, x: number): number[] => {
      const { position_m, quaternion } = placements[index] ?? { position_m: [NaN, NaN, NaN], quaternion: [1, 0, 0, 0] };
      return add(position_m, rotate(quaternion, [x, 0, 0]));
    };
    const near = (found: Vector3 | undefined, expected: number[]): void => {
      found?.toArray().forEach((value, axis) => {
        expect(value).toBeCloseTo(expected[axis] ?? NaN, 5);
      });
    };
    near(centres[0], place(0, 0));
    near(centres[2], place(2, 0.3));
    near(centres[3], place(3, 0.4));
  });

  it("keep the colours of their parts", () => {
    const colours = meshes(true).meshes.map(({ geometry }) => Array.from(geometry.getAttribute("color").array.slice(0, 3)));
    expect(colours).toEqual([[1, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]]);
  });
});
