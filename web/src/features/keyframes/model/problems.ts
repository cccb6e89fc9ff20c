/** Problems of a movement on a robot, and their corrections. */
import { clamp } from "../../../shared/lib/angles";
import { segmentsOf, rangeAt } from "./plan";
import type { Joint } from "../../../shared/mqtt/protocol.generated";
import { at, Curve, curveOf, MAX_TIME_RATIO, timesOf, type Limiting } from "./timeline-layout";
import { ACTION_KINDS, type ActionKind, type ControlValue, type Movement, type Robot, MAX_DURATION_S, MIN_INTERVAL_S, MAX_TEXT_LENGTH, TOLERANCE_RAD, normalize, roundTime, withKeyframe, setAction, setTime, startAtZero, inJointOrder } from "./keyframes";

/** A problem at one keyframe, and its fix. A `warning` does not prevent running. */
export interface Problem {
  severity: "error" | "warning";
  keyframe: number;
  /** The affected joint, if any. */
  joint: string | null;
  what:
    | { kind: "range"; lower_rad: number; upper_rad: number }
    | { kind: "narrowed"; lower_rad: number; upper_rad: number; by: string }
    | { kind: "mirrored"; of: string }
    | { kind: "unknown-joint" }
    | { kind: "unknown-name"; action: ActionKind; name: string }
    | { kind: "unsupported"; action: ActionKind }
    | { kind: "control-range"; label: string; lower: number; upper: number; unit: string }
    | { kind: "too-fast"; by: Limiting; needs_s: number }
    | { kind: "times" }
    | { kind: "late-joint" }
    | { kind: "too-long-text" };
  fix: ((movement: Movement) => Movement) | null;
}

export function problems(movement: Movement, robot: Robot): Problem[] {
  const { keyframes } = movement;
  const found = keyframes.flatMap((_, index) => [
    ...timeProblems(movement, index),
    ...positionProblems(movement, index, robot),
    ...actionProblems(movement, index, robot),
  ]);
  if (found.some(({ what }) => what.kind === "times")) return found;
  return [...found, ...lateJoints(movement, robot), ...fastProblems(movement, robot)].sort((a, b) => a.keyframe - b.keyframe);
}

function timeProblems({ keyframes }: Movement, index: number): Problem[] {
  const [before, one] = [keyframes[index - 1], keyframes[index]];
  if (one === undefined) return [];
  const increasing = before === undefined ? one.time_s === 0 : one.time_s - before.time_s >= MIN_INTERVAL_S - 1e-9;
  if (increasing && one.time_s <= MAX_DURATION_S) return [];
  return [{ severity: "error", keyframe: index, joint: null, what: { kind: "times" }, fix: withIncreasingTimes }];
}

function withIncreasingTimes(movement: Movement): Movement {
  let reached = -MIN_INTERVAL_S;
  return startAtZero({
    ...movement,
    keyframes: movement.keyframes.map((one) => {
      reached = Math.max(one.time_s, reached + MIN_INTERVAL_S);
      return { ...one, time_s: reached };
    }),
  });
}

function positionProblems(movement: Movement, index: number, robot: Robot): Problem[] {
  const positions = movement.keyframes[index]?.position_rad ?? {};
  const problem = (joint: string, what: Problem["what"], fix: Problem["fix"]): Problem => ({
    severity: "error",
    keyframe: index,
    joint,
    what,
    fix,
  });
  const without = (name: string) => (old: Movement) =>
    withKeyframe(old, index, (one) => ({
      ...one,
      position_rad: Object.fromEntries(Object.entries(one.position_rad).filter(([other]) => other !== name)),
    }));
  const inside = (name: string, lower: number, upper: number) => (old: Movement) =>
    withKeyframe(old, index, (one) => ({
      ...one,
      position_rad: { ...one.position_rad, [name]: normalize(one.position_rad[name] ?? 0, lower, upper) },
    }));
  return Object.entries(positions).flatMap(([name, position]): Problem[] => {
    const joint = robot.joints.find((one) => one.name === name);
    if (joint === undefined) return [problem(name, { kind: "unknown-joint" }, without(name))];
    const mirror = robot.mimic_joints.find((one) => one.joint === name);
    const leaderPosition = mirror === undefined ? undefined : positions[mirror.mimics];
    if (mirror !== undefined && leaderPosition !== undefined && Math.abs(position - leaderPosition * mirror.multiplier) > TOLERANCE_RAD) {
      return [problem(name, { kind: "mirrored", of: mirror.mimics }, without(name))];
    }
    const { lower_rad, upper_rad } = joint;
    if (!(position >= lower_rad && position <= upper_rad)) {
      return [problem(name, { kind: "range", lower_rad, upper_rad }, inside(name, lower_rad, upper_rad))];
    }
    const narrowing = robot.position_dependent_limits.find((one) => one.joint === name);
    const otherPosition = narrowing === undefined ? undefined : positionAt(movement, index, narrowing.depends_on);
    if (narrowing !== undefined && otherPosition !== undefined) {
      const [lower, upper] = rangeAt(narrowing.table, otherPosition);
      if (position < lower - TOLERANCE_RAD || position > upper + TOLERANCE_RAD) {
        const what = { kind: "narrowed", lower_rad: lower, upper_rad: upper, by: narrowing.depends_on } as const;
        return [problem(name, what, inside(name, lower, upper))];
      }
    }
    return [];
  });
}

/** A joint's position at a keyframe [rad], interpolated if it is not set; `undefined`: never set. */
export function positionAt({ keyframes }: Movement, index: number, joint: string): number | undefined {
  const points = keyframes.flatMap(({ time_s, position_rad }) => {
    const position = position_rad[joint];
    return position === undefined ? [] : [[time_s, position] as const];
  });
  const time = keyframes[index]?.time_s ?? 0;
  const own = keyframes[index]?.position_rad[joint];
  if (own !== undefined || points.length === 0) return own;
  return new Curve(points.map(([when]) => when), points.map(([, position]) => position)).at(time);
}

const NAMES = { posture: "postures", behaviour: "behaviours", express: "expressions" } as const;

function actionProblems(movement: Movement, index: number, robot: Robot): Problem[] {
  const keyframe = movement.keyframes[index] ?? { time_s: 0, position_rad: {} };
  return ACTION_KINDS.flatMap((action): Problem[] => {
    const value = keyframe[action];
    if (value === undefined) return [];
    const base = { severity: "error", keyframe: index, joint: null } as const;
    const fix = (old: Movement): Movement => setAction(old, index, action, undefined);
    if (!supports(robot, action)) return [{ ...base, what: { kind: "unsupported", action }, fix }];
    if ((action === "posture" || action === "behaviour" || action === "express") && typeof value === "string") {
      if (!robot[NAMES[action]].includes(value)) return [{ ...base, what: { kind: "unknown-name", action, name: value }, fix }];
    }
    if (action === "set_control" && keyframe.set_control !== undefined) return controlProblems(keyframe.set_control, index, robot);
    const long = action === "say" && typeof value === "string" && value.length > MAX_TEXT_LENGTH;
    return long ? [{ ...base, what: { kind: "too-long-text" }, fix: null }] : [];
  });
}

/** The control does not exist, or the value is outside of its limits. */
function controlProblems({ name, value }: ControlValue, index: number, { controls }: Robot): Problem[] {
  if (controls === null) return [];
  const base = { severity: "error", keyframe: index, joint: null } as const;
  const control = controls.find((one) => one.name === name);
  if (control === undefined) {
    const what = { kind: "unknown-name", action: "set_control", name } as const;
    return [{ ...base, what, fix: (old) => setAction(old, index, "set_control", undefined) }];
  }
  const { label, unit = "", lower, upper } = control;
  if (value >= lower && value <= upper) return [];
  const fix = (old: Movement): Movement => setAction(old, index, "set_control", { name, value: clamp(value, lower, upper) });
  return [{ ...base, what: { kind: "control-range", label, lower, upper, unit }, fix }];
}

const ACTIONS: Readonly<Record<ActionKind, string>> = {
  posture: "take_posture",
  behaviour: "run_behaviour",
  express: "express",
  say: "say",
  drive: "drive",
  go_to: "go_to",
  set_control: "set_control",
};

/** Whether the robot's description supports an action, or does not exclude it. */
export function supports(robot: Robot, action: ActionKind): boolean {
  return robot.actions.includes(ACTIONS[action]) || (action === "set_control" && robot.controls === null);
}

/** Joints without a position in the first keyframe: the robot starts them from their current position. */
function lateJoints(movement: Movement, robot: Robot): Problem[] {
  const first = movement.keyframes[0]?.position_rad ?? {};
  const followers = new Set(robot.mimic_joints.map(({ joint }) => joint));
  return robot.joints.flatMap(({ name }): Problem[] => {
    if (followers.has(name)) return [];
    const index = movement.keyframes.findIndex(({ position_rad }) => name in position_rad);
    const position = movement.keyframes[index]?.position_rad[name];
    if (index < 1 || position === undefined || name in first) return [];
    const fix = (old: Movement): Movement =>
      withKeyframe(old, 0, (one) => ({ ...one, position_rad: inJointOrder({ ...one.position_rad, [name]: position }, robot) }));
    return [{ severity: "warning", keyframe: index, joint: name, what: { kind: "late-joint" }, fix }];
  });
}

interface TooFast {
  joint: Joint;
  by: Limiting;
  /** Required time relative to the available time `duration_s` [s]. */
  timeRatio: number;
  duration_s: number;
}

/** The fastest joint of each keyframe, by the keyframe's index. */
function fastest({ keyframes }: Movement, robot: Robot): Map<number, TooFast> {
  const found = new Map<number, TooFast>();
  for (const { first, gaps, tracks } of segmentsOf(keyframes, robot)) {
    const times = timesOf(gaps);
    for (const { joint, waypoints } of tracks) {
      curveOf(waypoints, times)
        .segmentDemands(joint)
        .forEach(({ timeRatio, by }, index) => {
          const [begin, end] = [waypoints[index]?.index ?? 0, waypoints[index + 1]?.index ?? 0];
          if (timeRatio <= MAX_TIME_RATIO || timeRatio <= (found.get(first + end)?.timeRatio ?? 0)) return;
          found.set(first + end, { joint, by, timeRatio, duration_s: at(times, end) - at(times, begin) });
        });
    }
  }
  return found;
}

function fastProblems(movement: Movement, robot: Robot): Problem[] {
  return [...fastest(movement, robot)].map(([keyframe, { joint, by }]) => {
    const fixed = slowed(movement, keyframe, robot);
    const [begin, end] = [fixed.keyframes[keyframe - 1]?.time_s ?? 0, fixed.keyframes[keyframe]?.time_s ?? 0];
    return {
      severity: "error",
      keyframe,
      joint: joint.name,
      what: { kind: "too-fast", by, needs_s: roundTime(end - begin) },
      fix: (old) => slowed(old, keyframe, robot),
    };
  });
}

/** The movement with enough time before a keyframe for all joints. */
function slowed(movement: Movement, keyframe: number, robot: Robot): Movement {
  let changed = movement;
  for (let iteration = 0; iteration < 60; iteration += 1) {
    const worst = fastest(changed, robot).get(keyframe);
    const old = changed.keyframes[keyframe];
    if (worst === undefined || old === undefined) break;
    const time = Math.ceil((old.time_s + (worst.timeRatio - 1) * worst.duration_s) * 100 - 1e-6) / 100;
    changed = setTime(changed, keyframe, Math.max(time, old.time_s + 0.01), true);
  }
  return changed;
}

/** The movement with enough time before every keyframe. */
export function stretchAll(movement: Movement, robot: Robot): Movement {
  let changed = movement;
  for (let iteration = 0; iteration < 20; iteration += 1) {
    const all = [...fastest(changed, robot).keys()].sort((a, b) => a - b);
    if (all.length === 0) break;
    for (const keyframe of all) changed = slowed(changed, keyframe, robot);
  }
  return changed;
}
