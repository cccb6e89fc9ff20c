/** Geometry of lidar scans and tracked people, for drawings. */
import type { KnownPeople, KnownPerson, LidarScan } from "../mqtt/sensor-frames";
import type { Vector3 } from "./vectors";

/** Connected joints of Kinect v1. */
const BONES: readonly (readonly [string, string])[] = [
  ["head", "shoulder_center"],
  ["shoulder_center", "spine"],
  ["spine", "hip_center"],
  ...["left", "right"].flatMap((side): [string, string][] => [
    ["shoulder_center", `shoulder_${side}`],
    [`shoulder_${side}`, `elbow_${side}`],
    [`elbow_${side}`, `wrist_${side}`],
    [`wrist_${side}`, `hand_${side}`],
    ["hip_center", `hip_${side}`],
    [`hip_${side}`, `knee_${side}`],
    [`knee_${side}`, `ankle_${side}`],
    [`ankle_${side}`, `foot_${side}`],
  ]),
];

export interface Bone {
  from: Vector3;
  to: Vector3;
  /** Whether the sensor sees both ends. */
  tracked: boolean;
}

/** The bones whose two joints are known. */
export function bonesOf(person: KnownPerson): Bone[] {
  const joints = new Map(person.joints.map((joint) => [joint.name, joint]));
  return BONES.flatMap(([first, second]) => {
    const [from, to] = [joints.get(first), joints.get(second)];
    if (from === undefined || to === undefined) return [];
    return [{ from: from.position_m, to: to.position_m, tracked: from.state === "tracked" && to.state === "tracked" }];
  });
}

/** Pixel of a place in the picture of the camera that tracks the people; `null` behind the camera. */
export function projected({ position_m: camera, rotation, fovy_rad: fovy }: Omit<KnownPeople, "people">, place: Vector3, width: number, height: number): [number, number] | null {
  const offset = place.map((value, axis) => value - (camera[axis] ?? 0));
  const along = (column: 0 | 1 | 2): number => rotation.reduce((sum, row, axis) => sum + row[column] * (offset[axis] ?? 0), 0);
  const depth = -along(2);
  if (depth <= 0) return null;
  const focal = height / 2 / Math.tan(fovy / 2);
  return [width / 2 + (focal * along(0)) / depth, height / 2 - (focal * along(1)) / depth];
}

/** Places on the floor where beams ended [m]; none for a scan without a pose. */
export function echoesOf({ position_m: lidar, rotation, angle_rad: angles, range_m: ranges }: LidarScan): [number, number][] {
  if (lidar === null || rotation === null) return [];
  return ranges.flatMap((range, index): [number, number][] => {
    const angle = angles[index];
    if (range === null || angle === undefined) return [];
    const [ahead, left] = [range * Math.cos(angle), range * Math.sin(angle)];
    const at = (axis: 0 | 1): number => lidar[axis] + rotation[axis][0] * ahead + rotation[axis][1] * left;
    return [[at(0), at(1)]];
  });
}
