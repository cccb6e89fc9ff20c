/** Steering modes from a device's description, and the velocities for pressed inputs. */
import { clamp } from "../../../shared/lib/angles";
import type { KnownDescription } from "../../../shared/mqtt/parse-messages";
import type { BaseLimits, DriveTarget, JogTarget } from "../../../shared/mqtt/protocol.generated";
import type { Vector3 } from "../../../shared/lib/vectors";

export type SteeringMode = "joints" | "jog" | "drive";
/** A velocity, active only while an input is held. */
export type Velocity = JogTarget | DriveTarget;

/** The steering modes that a device supports. */
export function steeringModesOf(description: KnownDescription | null): SteeringMode[] {
  if (description === null) return [];
  const modes: SteeringMode[] = [];
  if (description.joints.length > 0) modes.push("joints");
  // A robot that can move a frame to a pose can also jog it: both need its kinematics.
  if (description.actions.includes("move_pose") && description.frames.length > 0) modes.push("jog");
  if (description.base !== null) modes.push("drive");
  return modes;
}

/** The zero velocity of the same kind. */
export function zeroOf(velocity: Velocity): Velocity {
  if (velocity.kind === "drive") return { kind: "drive", forward_m_s: 0, left_m_s: 0, turn_rad_s: 0 };
  return { ...velocity, linear_m_s: [0, 0, 0], angular_rad_s: [0, 0, 0] };
}

/** Directions of a jog, -1…1 each: along x, y, z, about x, y, z. */
export interface Direction {
  along: Vector3;
  about: Vector3;
}

/** Deflection of a stick, -1…1 each: forward, left, counter-clockwise. */
export interface Push {
  forward: number;
  left: number;
  turn: number;
}

export const AT_REST: Push = { forward: 0, left: 0, turn: 0 };

interface JogSpeed {
  linear_m_s: number;
  angular_rad_s: number;
}

function scaleOf(vector: Vector3): number {
  return Math.max(1, Math.hypot(...vector));
}

/** The jog velocity for a direction. Diagonal motion is limited to the same speed. */
export function jogOf({ along, about }: Direction, speed: JogSpeed, frame: string, tool: boolean): JogTarget {
  const scaled = (vector: Vector3, by: number): Vector3 => vector.map((part) => (part * by) / scaleOf(vector)) as Vector3;
  return {
    kind: "jog",
    linear_m_s: scaled(along, speed.linear_m_s),
    angular_rad_s: scaled(about, speed.angular_rad_s),
    frame,
    tool,
  };
}

/** `share`: share of the base's maximum speed, 0…1. */
export function driveOf(push: Push, limits: BaseLimits, share: number): DriveTarget {
  const part = (value: number, limit: number): number => clamp(value, -1, 1) * limit * clamp(share, 0, 1);
  return {
    kind: "drive",
    forward_m_s: part(push.forward, limits.forward_m_s),
    left_m_s: part(push.left, limits.left_m_s),
    turn_rad_s: part(push.turn, limits.turn_rad_s),
  };
}

/** The sum of all pressed directions. */
export function sumOf(directions: Iterable<Direction>): Direction {
  const sum: Direction = { along: [0, 0, 0], about: [0, 0, 0] };
  for (const { along, about } of directions) {
    for (const axis of [0, 1, 2] as const) {
      sum.along[axis] = clamp(sum.along[axis] + along[axis], -1, 1);
      sum.about[axis] = clamp(sum.about[axis] + about[axis], -1, 1);
    }
  }
  return sum;
}

export function sumOfPushes(pushes: Iterable<Push>): Push {
  const sum = { ...AT_REST };
  for (const push of pushes) {
    sum.forward = clamp(sum.forward + push.forward, -1, 1);
    sum.left = clamp(sum.left + push.left, -1, 1);
    sum.turn = clamp(sum.turn + push.turn, -1, 1);
  }
  return sum;
}

export function direction(kind: keyof Direction, axis: 0 | 1 | 2, sign: 1 | -1): Direction {
  const result: Direction = { along: [0, 0, 0], about: [0, 0, 0] };
  result[kind][axis] = sign;
  return result;
}
