/** Contents of frames and captures that are JSON: lidar scans and tracked people. */
import type { Vector3 } from "../lib/vectors";
import { count, fail, list, MAX_JOINTS, MessageError, nullable, number, numbers, object, oneOf, optional, text, type Check } from "./checks";
import type { BodyJoint, TrackedPeople, TrackedPerson } from "./protocol.generated";

/** Rows of the matrix whose columns are the sensor's axes in the room. */
export type Rotation = [Vector3, Vector3, Vector3];

/** One lidar revolution. `range_m` is `null` for a beam without an echo; the pose is `null` in scans of old captures. */
export interface LidarScan {
  position_m: Vector3 | null;
  rotation: Rotation | null;
  angle_rad: number[];
  range_m: (number | null)[];
  furthest_m: number;
}

export interface KnownPerson extends TrackedPerson {
  joints: BodyJoint[];
}

export interface KnownPeople extends TrackedPeople {
  people: KnownPerson[];
}

const MAX_BEAMS = 100_000;
const MAX_PEOPLE = 16;

const vector3 = numbers<Vector3>(3);

const rotation: Check<Rotation> = (value, at, key) => {
  const [x, y, z, ...more] = list(vector3, 3)(value, at, key);
  if (x === undefined || y === undefined || z === undefined || more.length > 0) fail(at, "a rotation matrix", key);
  return [x, y, z];
};

const scan = object<LidarScan>({
  position_m: nullable(vector3),
  rotation: nullable(rotation),
  angle_rad: list(number, MAX_BEAMS),
  range_m: list(nullable(number), MAX_BEAMS),
  furthest_m: number,
});

const joint = object<BodyJoint>({ name: text, position_m: vector3, state: oneOf("tracked", "inferred") });

const person = object<KnownPerson>({ id: count, position_m: vector3, joints: optional(list(joint, MAX_JOINTS), []) });

const people = object<KnownPeople>({
  position_m: vector3,
  rotation,
  fovy_rad: number,
  people: optional(list(person, MAX_PEOPLE), []),
});

/** The content of a `scan` frame or file. Throws `MessageError`. */
export function readScan(content: Uint8Array): LidarScan {
  const found = scan(parsed(content, "scan"), "scan");
  if (found.angle_rad.length !== found.range_m.length) fail("scan.range_m", "as long as angle_rad");
  return found;
}

/** The content of a `people` frame. Throws `MessageError`. */
export function readPeople(content: Uint8Array): KnownPeople {
  const found = people(parsed(content, "people"), "people");
  if (!(found.fovy_rad > 0 && found.fovy_rad < Math.PI)) fail("people.fovy_rad", "an angle between 0 and π");
  return found;
}

function parsed(content: Uint8Array, label: string): unknown {
  try {
    return JSON.parse(new TextDecoder().decode(content));
  } catch {
    throw new MessageError(`${label} is not JSON`);
  }
}
