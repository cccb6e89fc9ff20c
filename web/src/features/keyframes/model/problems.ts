/** Problems of a movement on a robot, and their corrections. */
import { pieces, room } from "./plan";
import type { Joint } from "../../../shared/mqtt/protocol.generated";
import { at, Curve, curveOf, FITS, moments, type Limiting } from "./timeline-layout";
import { ACTION_KINDS, type ActionKind, type Movement, type Robot, LONGEST_S, SHORTEST_S, LONGEST_TEXT, SAME_RAD, normalize, tidyTime, withKeyframe, setAction, setTime, startAtZero, inOrder } from "./keyframes";

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
    | { kind: "unknown-name"; deed: ActionKind; name: string }
    | { kind: "cannot"; deed: ActionKind }
    | { kind: "too-fast"; by: Limiting; needs_s: number }
    | { kind: "times" }
    | { kind: "late-joint" }
    | { kind: "too-long-text" };
  mend: ((movement: Movement) => Movement) | null;
}

export function problems(movement: Movement, robot: Robot): Problem[] {
  const { keyframes } = movement;
  const found = keyframes.flatMap((_, index) => [
    ...timeProblems(movement, index),
    ...placeProblems(movement, index, robot),
    ...deedProblems(movement, index, robot),
  ]);
  if (found.some(({ what }) => what.kind === "times")) return found;
  return [...found, ...lateJoints(movement, robot), ...fastProblems(movement, robot)].sort((a, b) => a.keyframe - b.keyframe);
}

function timeProblems({ keyframes }: Movement, index: number): Problem[] {
  const [before, one] = [keyframes[index - 1], keyframes[index]];
  if (one === undefined) return [];
  const rises = before === undefined ? one.time_s === 0 : one.time_s - before.time_s >= SHORTEST_S - 1e-9;
  if (rises && one.time_s <= LONGEST_S) return [];
  return [{ severity: "error", keyframe: index, joint: null, what: { kind: "times" }, mend: rising }];
}

function rising(movement: Movement): Movement {
  let reached = -SHORTEST_S;
  return startAtZero({
    ...movement,
    keyframes: movement.keyframes.map((one) => {
      reached = Math.max(one.time_s, reached + SHORTEST_S);
      return { ...one, time_s: reached };
    }),
  });
}

function placeProblems(movement: Movement, index: number, robot: Robot): Problem[] {
  const positions = movement.keyframes[index]?.position_rad ?? {};
  const say = (joint: string, what: Problem["what"], mend: Problem["mend"]): Problem => ({
    severity: "error",
    keyframe: index,
    joint,
    what,
    mend,
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
  return Object.entries(positions).flatMap(([name, place]): Problem[] => {
    const joint = robot.joints.find((one) => one.name === name);
    if (joint === undefined) return [say(name, { kind: "unknown-joint" }, without(name))];
    const mirror = robot.mimic_joints.find((one) => one.joint === name);
    const leads = mirror === undefined ? undefined : positions[mirror.mimics];
    if (mirror !== undefined && leads !== undefined && Math.abs(place - leads * mirror.multiplier) > SAME_RAD) {
      return [say(name, { kind: "mirrored", of: mirror.mimics }, without(name))];
    }
    const { lower_rad, upper_rad } = joint;
    if (!(place >= lower_rad && place <= upper_rad)) {
      return [say(name, { kind: "range", lower_rad, upper_rad }, inside(name, lower_rad, upper_rad))];
    }
    const narrowing = robot.position_dependent_limits.find((one) => one.joint === name);
    const where = narrowing === undefined ? undefined : placeOf(movement, index, narrowing.depends_on);
    if (narrowing !== undefined && where !== undefined) {
      const [lower, upper] = room(narrowing.table, where);
      if (place < lower - SAME_RAD || place > upper + SAME_RAD) {
        const what = { kind: "narrowed", lower_rad: lower, upper_rad: upper, by: narrowing.depends_on } as const;
        return [say(name, what, inside(name, lower, upper))];
      }
    }
    return [];
  });
}

/** A joint's position at a keyframe [rad], interpolated if it is not set; `undefined`: never set. */
export function placeOf({ keyframes }: Movement, index: number, joint: string): number | undefined {
  const said = keyframes.flatMap(({ time_s, position_rad }) => {
    const place = position_rad[joint];
    return place === undefined ? [] : [[time_s, place] as const];
  });
  const time = keyframes[index]?.time_s ?? 0;
  const here = keyframes[index]?.position_rad[joint];
  if (here !== undefined || said.length === 0) return here;
  return new Curve(said.map(([when]) => when), said.map(([, place]) => place)).at(time);
}

const NAMES = { posture: "postures", behaviour: "behaviours", express: "expressions" } as const;

function deedProblems(movement: Movement, index: number, robot: Robot): Problem[] {
  const keyframe = movement.keyframes[index] ?? { time_s: 0, position_rad: {} };
  return ACTION_KINDS.flatMap((deed): Problem[] => {
    const value = keyframe[deed];
    if (value === undefined) return [];
    const base = { severity: "error", keyframe: index, joint: null } as const;
    const mend = (old: Movement): Movement => setAction(old, index, deed, undefined);
    if (!supports(robot, deed)) return [{ ...base, what: { kind: "cannot", deed }, mend }];
    if ((deed === "posture" || deed === "behaviour" || deed === "express") && typeof value === "string") {
      if (!robot[NAMES[deed]].includes(value)) return [{ ...base, what: { kind: "unknown-name", deed, name: value }, mend }];
    }
    const long = deed === "say" && typeof value === "string" && value.length > LONGEST_TEXT;
    return long ? [{ ...base, what: { kind: "too-long-text" }, mend: null }] : [];
  });
}

const ACTIONS: Readonly<Record<ActionKind, string>> = {
  posture: "take_posture",
  behaviour: "run_behaviour",
  express: "express",
  say: "say",
  drive: "drive",
  go_to: "go_to",
};

/** Whether the robot's description supports a step. */
export function supports(robot: Robot, deed: ActionKind): boolean {
  return robot.actions.includes(ACTIONS[deed]);
}

/** Joints without a position in the first keyframe: the robot starts them from their current position. */
function lateJoints(movement: Movement, robot: Robot): Problem[] {
  const first = movement.keyframes[0]?.position_rad ?? {};
  const followers = new Set(robot.mimic_joints.map(({ joint }) => joint));
  return robot.joints.flatMap(({ name }): Problem[] => {
    if (followers.has(name)) return [];
    const index = movement.keyframes.findIndex(({ position_rad }) => name in position_rad);
    const place = movement.keyframes[index]?.position_rad[name];
    if (index < 1 || place === undefined || name in first) return [];
    const mend = (old: Movement): Movement =>
      withKeyframe(old, 0, (one) => ({ ...one, position_rad: inOrder({ ...one.position_rad, [name]: place }, robot) }));
    return [{ severity: "warning", keyframe: index, joint: name, what: { kind: "late-joint" }, mend }];
  });
}

interface TooFast {
  joint: Joint;
  by: Limiting;
  /** The required and the available time, relative [s]. */
  over: number;
  lasts_s: number;
}

/** The fastest joint of each keyframe, by the keyframe's index. */
function fastest({ keyframes }: Movement, robot: Robot): Map<number, TooFast> {
  const found = new Map<number, TooFast>();
  for (const { first, gaps, tracks } of pieces(keyframes, robot)) {
    const times = moments(gaps);
    for (const { joint, stays } of tracks) {
      curveOf(stays, times)
        .stretches(joint)
        .forEach(({ over, by }, index) => {
          const [begin, end] = [stays[index]?.number ?? 0, stays[index + 1]?.number ?? 0];
          if (over <= FITS || over <= (found.get(first + end)?.over ?? 0)) return;
          found.set(first + end, { joint, by, over, lasts_s: at(times, end) - at(times, begin) });
        });
    }
  }
  return found;
}

function fastProblems(movement: Movement, robot: Robot): Problem[] {
  return [...fastest(movement, robot)].map(([keyframe, { joint, by }]) => {
    const mended = slowed(movement, keyframe, robot);
    const [begin, end] = [mended.keyframes[keyframe - 1]?.time_s ?? 0, mended.keyframes[keyframe]?.time_s ?? 0];
    return {
      severity: "error",
      keyframe,
      joint: joint.name,
      what: { kind: "too-fast", by, needs_s: tidyTime(end - begin) },
      mend: (old) => slowed(old, keyframe, robot),
    };
  });
}

/** The movement with enough time before a keyframe for all joints. */
function slowed(movement: Movement, keyframe: number, robot: Robot): Movement {
  let now = movement;
  for (let tries = 0; tries < 60; tries += 1) {
    const worst = fastest(now, robot).get(keyframe);
    const old = now.keyframes[keyframe];
    if (worst === undefined || old === undefined) break;
    const time = Math.ceil((old.time_s + (worst.over - 1) * worst.lasts_s) * 100 - 1e-6) / 100;
    now = setTime(now, keyframe, Math.max(time, old.time_s + 0.01), true);
  }
  return now;
}

/** The movement with enough time everywhere. */
export function stretchAll(movement: Movement, robot: Robot): Movement {
  let now = movement;
  for (let tries = 0; tries < 20; tries += 1) {
    const all = [...fastest(now, robot).keys()].sort((a, b) => a - b);
    if (all.length === 0) break;
    for (const keyframe of all) now = slowed(now, keyframe, robot);
  }
  return now;
}
