/** Forward kinematics of a twin, equal to MuJoCo's. */
import type { KnownBody, KnownTwin } from "../../../shared/mqtt/parse-messages";
import type { TwinJoint } from "../../../shared/mqtt/protocol.generated";
import type { Quaternion, Vector3 } from "../../../shared/lib/vectors";

interface Placement {
  position_m: Vector3;
  quaternion: Quaternion;
}

export function multiply(a: Quaternion, b: Quaternion): Quaternion {
  return [
    a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
    a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
    a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
    a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
  ];
}

/** Rotates `vector` by a unit quaternion. */
export function rotate(q: Quaternion, vector: Vector3): Vector3 {
  const [w, x, y, z] = q;
  const [a, b, c] = vector;
  // t = 2 (q × v); v' = v + w t + q × t
  const t: Vector3 = [2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)];
  return [
    a + w * t[0] + y * t[2] - z * t[1],
    b + w * t[1] + z * t[0] - x * t[2],
    c + w * t[2] + x * t[1] - y * t[0],
  ];
}

export function add(a: Vector3, b: Vector3): Vector3 {
  return [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
}

export function unit(q: Quaternion): Quaternion {
  const length = Math.hypot(...q);
  return [q[0] / length, q[1] / length, q[2] / length, q[3] / length];
}

function about(axis: Vector3, angle: number): Quaternion {
  const s = Math.sin(angle / 2) / Math.hypot(...axis);
  return [Math.cos(angle / 2), axis[0] * s, axis[1] * s, axis[2] * s];
}

/** A joint's position [rad or m]: passive joints follow others; absent ones are at their reference. */
export function jointPosition(joint: TwinJoint | null, positions: Readonly<Record<string, number>>): number {
  if (joint === null) return 0;
  const followed = Object.entries(joint.follows ?? {});
  if (followed.length === 0) return positions[joint.name] ?? joint.reference_rad ?? 0;
  return followed.reduce((sum, [name, factor]) => sum + factor * (positions[name] ?? 0), 0);
}

/** A body's placement in its parent's frame with its joint at `position` [rad or m]. */
export function placementOf(body: KnownBody, position: number): Placement {
  const quaternion = unit(body.quaternion);
  const { joint } = body;
  if (joint === null) return { position_m: body.position_m, quaternion };
  const moved = position - (joint.reference_rad ?? 0);
  if (joint.kind === "slide") {
    const length = Math.hypot(...joint.axis);
    const along = joint.axis.map((part) => (part * moved) / length) as Vector3;
    return { position_m: add(body.position_m, rotate(quaternion, along)), quaternion };
  }
  // The anchor does not move when the body turns.
  const turned = multiply(quaternion, about(joint.axis, moved));
  const anchor = add(body.position_m, rotate(quaternion, joint.anchor_m));
  const [x, y, z] = rotate(turned, joint.anchor_m);
  return { position_m: [anchor[0] - x, anchor[1] - y, anchor[2] - z], quaternion: turned };
}

/** Every body in the robot's base, in the order of the twin. Absent joints are at their reference. */
export function forward(twin: KnownTwin, positions: Readonly<Record<string, number>>): Placement[] {
  const world: Placement[] = [];
  for (const body of twin.bodies) {
    const own = placementOf(body, jointPosition(body.joint, positions));
    const parent = world[body.parent];
    world.push(
      parent === undefined
        ? own
        : {
            position_m: add(parent.position_m, rotate(parent.quaternion, own.position_m)),
            quaternion: multiply(parent.quaternion, own.quaternion),
          },
    );
  }
  return world;
}

/** Each joint's anchor and its body's rotation, in the order of the twin. */
export function jointFrames(twin: KnownTwin, positions: Readonly<Record<string, number>>): (Placement & { name: string })[] {
  const world = forward(twin, positions);
  return twin.bodies.flatMap(({ joint }, index) => {
    const placement = world[index];
    if (joint === null || placement === undefined) return [];
    const { position_m: at, quaternion } = placement;
    return [{ name: joint.name, position_m: add(at, rotate(quaternion, joint.anchor_m)), quaternion }];
  });
}

/** Closer than this to a pitch of ±90°, roll and yaw share an axis: the rotation is assigned to roll. */
const LOCKED = 1 - 1e-9;

/** Roll, pitch and yaw [rad] of a unit quaternion: rotations about the fixed x, y and z axes. */
export function rollPitchYaw([w, x, y, z]: Quaternion): Vector3 {
  const sinPitch = 2 * (w * y - z * x);
  if (Math.abs(sinPitch) > LOCKED) {
    const roll = 2 * Math.atan2(x, w);
    return [Math.atan2(Math.sin(roll), Math.cos(roll)), (Math.sign(sinPitch) * Math.PI) / 2, 0];
  }
  return [
    Math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
    Math.asin(sinPitch),
    Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
  ];
}
