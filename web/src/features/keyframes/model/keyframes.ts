/** A movement as keyframes: joint positions and actions at times. All functions are pure and return new objects. */
import { clamp } from "../../../shared/lib/angles";
import type { KnownDescription } from "../../../shared/mqtt/parse-messages";
import type { Control, Joint } from "../../../shared/mqtt/protocol.generated";

export type Positions = Readonly<Record<string, number>>;

interface Drive {
  forward_m_s: number;
  turn_rad_s: number;
  duration_s: number;
}

interface Place {
  x_m: number;
  y_m: number;
  yaw_rad?: number;
}

/** A value of a control of the robot, in the unit of the control. */
export interface ControlValue {
  name: string;
  value: number;
}

/** Actions at a keyframe, executed in this order while the movement pauses. */
export interface KeyframeActions {
  posture?: string;
  behaviour?: string;
  express?: string;
  say?: string;
  drive?: Drive;
  go_to?: Place;
  set_control?: ControlValue;
}

export const ACTION_KINDS = ["posture", "behaviour", "express", "say", "drive", "go_to", "set_control"] as const;

export type ActionKind = (typeof ACTION_KINDS)[number];

export interface Keyframe extends KeyframeActions {
  time_s: number;
  /** Absent joints are interpolated. */
  position_rad: Positions;
}

export interface Movement {
  /** One line. */
  description: string;
  /** At least one; the first is at 0 s. */
  keyframes: readonly Keyframe[];
}

/** The robot properties that the editor uses. */
export type Robot = Pick<
  KnownDescription,
  "joints" | "mimic_joints" | "position_dependent_limits" | "postures" | "expressions" | "behaviours" | "capabilities" | "actions"
> & {
  /** `null`: unknown, because a robot type does not declare the controls of its robots. */
  controls: readonly Control[] | null;
};

export const MAX_DURATION_S = 600;

/** Minimum time between two keyframes [s]. */
export const MIN_INTERVAL_S = 0.05;

/** Maximum length of a keyframe's text that a robot accepts. */
export const MAX_TEXT_LENGTH = 500;

const STEP_RAD = 1e-4;

/** Preview duration of an action of unknown duration, such as speech [s]. */
export const ACTION_PREVIEW_S = 0.8;

export const TOLERANCE_RAD = 1e-6;

/** A position rounded to the stored precision, within a range. */
export function normalize(value: number, lower: number, upper: number): number {
  const inside = clamp(value, lower, upper);
  const steps = Math.round(inside / STEP_RAD);
  const rounded = steps * STEP_RAD > upper ? Math.floor(upper / STEP_RAD) : steps * STEP_RAD < lower ? Math.ceil(lower / STEP_RAD) : steps;
  return Number((rounded * STEP_RAD).toFixed(4)) + 0;
}

/** Rounds a time to hundredths of a second. */
export function roundTime(time: number): number {
  return Number(time.toFixed(2));
}

export function withKeyframe(movement: Movement, index: number, change: (old: Keyframe) => Keyframe): Movement {
  return { ...movement, keyframes: movement.keyframes.map((one, other) => (other === index ? change(one) : one)) };
}

/** Sets a joint's position at a keyframe [rad]; `null` removes it. */
export function setPosition(movement: Movement, index: number, joint: Joint, position: number | null, robot: Robot): Movement {
  const mirror = robot.mimic_joints.find((one) => one.joint === joint.name);
  const leader = robot.joints.find((one) => one.name === mirror?.mimics);
  if (mirror !== undefined && leader !== undefined) {
    return setPosition(movement, index, leader, position === null ? null : position / mirror.multiplier, robot);
  }
  return withKeyframe(movement, index, (old) => {
    const all = { ...old.position_rad };
    if (position === null) Reflect.deleteProperty(all, joint.name);
    else all[joint.name] = normalize(position, joint.lower_rad, joint.upper_rad);
    return { ...old, position_rad: inJointOrder(all, robot) };
  });
}

/** Sets all positions of joints that the robot has and that are not coupled to another. */
export function setPose(movement: Movement, index: number, positions: Positions, robot: Robot): Movement {
  return withKeyframe(movement, index, (old) => ({ ...old, position_rad: poseOf(positions, robot) }));
}

export function poseOf(positions: Positions, robot: Robot): Positions {
  const followers = new Set(robot.mimic_joints.map(({ joint }) => joint));
  const entries = robot.joints.flatMap(({ name, lower_rad, upper_rad }) => {
    const value = positions[name];
    return value === undefined || followers.has(name) ? [] : [[name, normalize(value, lower_rad, upper_rad)] as const];
  });
  return Object.fromEntries(entries);
}

/** Sets or removes (`undefined`) an action at a keyframe. */
export function setAction<D extends ActionKind>(movement: Movement, index: number, kind: D, value: KeyframeActions[D] | undefined): Movement {
  return withKeyframe(movement, index, (old) => {
    const { time_s, position_rad, ...actions } = old;
    const next: KeyframeActions = { ...actions };
    if (value === undefined) Reflect.deleteProperty(next, kind);
    else next[kind] = value;
    return { time_s, position_rad, ...actionsOf(next) };
  });
}

/** The actions of a keyframe, in order of execution. */
export function actionsOf(keyframe: KeyframeActions): KeyframeActions {
  return Object.fromEntries(ACTION_KINDS.filter((kind) => keyframe[kind] !== undefined).map((kind) => [kind, keyframe[kind]]));
}

export function hasAction(keyframe: KeyframeActions): boolean {
  return ACTION_KINDS.some((kind) => keyframe[kind] !== undefined);
}

/** Moves a keyframe in time between its neighbours, or with all later ones (`shifting`). The first one stays at 0. */
export function setTime(movement: Movement, index: number, time: number, shifting: boolean): Movement {
  const { keyframes } = movement;
  const before = keyframes[index - 1];
  const old = keyframes[index];
  if (before === undefined || old === undefined || !Number.isFinite(time)) return movement;
  const after = shifting ? undefined : keyframes[index + 1];
  const latest = shifting ? MAX_DURATION_S - ((keyframes.at(-1)?.time_s ?? 0) - old.time_s) : (after?.time_s ?? MAX_DURATION_S + MIN_INTERVAL_S) - MIN_INTERVAL_S;
  const moved = roundTime(clamp(time, before.time_s + MIN_INTERVAL_S, Math.max(latest, before.time_s + MIN_INTERVAL_S)));
  const shift = moved - old.time_s;
  return {
    ...movement,
    keyframes: keyframes.map((one, other) => {
      if (other === index) return { ...one, time_s: moved };
      return shifting && other > index ? { ...one, time_s: roundTime(one.time_s + shift) } : one;
    }),
  };
}

/** Inserts a keyframe after another one, with the same joints: in the middle of the gap, or one second later. */
export function addAfter(movement: Movement, index: number, positions: Positions): Movement {
  const { keyframes } = movement;
  const [old, after] = [keyframes[index], keyframes[index + 1]];
  if (old === undefined) return movement;
  const time_s = roundTime(after === undefined ? old.time_s + 1 : (old.time_s + after.time_s) / 2);
  const added: Keyframe = { time_s, position_rad: positions };
  const fits = after === undefined || after.time_s - old.time_s >= 2 * MIN_INTERVAL_S;
  const next = { ...movement, keyframes: keyframes.toSpliced(index + 1, 0, added) };
  return fits ? next : setTime(next, index + 1, old.time_s + 1, true);
}

/** Duplicates a keyframe one second later; later keyframes are shifted. */
export function duplicate(movement: Movement, index: number): Movement {
  const old = movement.keyframes[index];
  if (old === undefined) return movement;
  const next = { ...movement, keyframes: movement.keyframes.toSpliced(index + 1, 0, { ...old }) };
  return setTime(next, index + 1, old.time_s + 1, true);
}

/** Removes a keyframe unless it is the only one. */
export function remove(movement: Movement, index: number): Movement {
  if (movement.keyframes.length < 2) return movement;
  return startAtZero({ ...movement, keyframes: movement.keyframes.toSpliced(index, 1) });
}

/** Shifts all keyframes so that the first is at 0. */
export function startAtZero(movement: Movement): Movement {
  const begin = movement.keyframes[0]?.time_s ?? 0;
  return {
    ...movement,
    keyframes: movement.keyframes.map((one) => ({ ...one, time_s: roundTime(one.time_s - begin) })),
  };
}

export function inJointOrder(positions: Positions, robot: Robot): Positions {
  const known = robot.joints.map(({ name }) => name).filter((name) => name in positions);
  const others = Object.keys(positions).filter((name) => !known.includes(name));
  return Object.fromEntries([...known, ...others].map((name) => [name, positions[name] ?? NaN]));
}
