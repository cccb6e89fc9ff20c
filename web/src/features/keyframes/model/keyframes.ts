/**
 * A movement as keyframes: when which joints are where, and what else is done there. The same few words serve an arm, a
 * humanoid, a base and a head. Everything here is pure; what it gives back is new.
 */
import { clamp } from "../../../shared/lib/angles";
import type { KnownDescription } from "../../../shared/mqtt/parse-messages";
import type { Joint } from "../../../shared/mqtt/protocol.generated";
import { at, Curve, curveOf, fitted, FITS, moments, type Limiting, type Stay } from "./timeline-layout";

export type Positions = Readonly<Record<string, number>>;

export interface Drive {
  forward_m_s: number;
  turn_rad_s: number;
  duration_s: number;
}

export interface Place {
  x_m: number;
  y_m: number;
  yaw_rad?: number;
}

/** What is done where a keyframe is reached, one after the other in this order, while time stands still. */
export interface KeyframeActions {
  posture?: string;
  behaviour?: string;
  express?: string;
  say?: string;
  drive?: Drive;
  go_to?: Place;
}

export const ACTION_KINDS = ["posture", "behaviour", "express", "say", "drive", "go_to"] as const;
export type ActionKind = (typeof ACTION_KINDS)[number];

export interface Keyframe extends KeyframeActions {
  time_s: number;
  /** Joints that are not named are on their way to where the next keyframe names them. */
  position_rad: Positions;
}

export interface Movement {
  /** What it is, in a line. */
  description: string;
  /** At least one; the first is at 0 s. */
  keyframes: readonly Keyframe[];
}

/** What the editor needs to know of a robot. */
export type Robot = Pick<
  KnownDescription,
  "joints" | "mimic_joints" | "position_dependent_limits" | "postures" | "expressions" | "behaviours" | "capabilities" | "actions"
>;

export const LONGEST_S = 600;
/** Between two keyframes there is at least this much time [s]. */
export const SHORTEST_S = 0.05;
/** Text of a keyframe, as the robot takes it. */
export const LONGEST_TEXT = 500;
const STEP_RAD = 1e-4;
/** How long the preview stays where something is done [s]: how long that takes, nobody knows before. */
const DEED_S = 0.8;
const SAME_RAD = 1e-6;

// ---------------------------------------------------------------- edits

/** A position as it is written down: in whole steps, and inside of a range. */
export function normalize(value: number, lower: number, upper: number): number {
  const inside = clamp(value, lower, upper);
  const steps = Math.round(inside / STEP_RAD);
  const rounded = steps * STEP_RAD > upper ? Math.floor(upper / STEP_RAD) : steps * STEP_RAD < lower ? Math.ceil(lower / STEP_RAD) : steps;
  return Number((rounded * STEP_RAD).toFixed(4)) + 0;
}

/** Times in hundredths of a second. */
function tidyTime(time: number): number {
  return Number(time.toFixed(2));
}

export function withKeyframe(movement: Movement, index: number, change: (old: Keyframe) => Keyframe): Movement {
  return { ...movement, keyframes: movement.keyframes.map((one, other) => (other === index ? change(one) : one)) };
}

/** Where a joint is at a keyframe [rad]; `null`: it passes there, on its way. */
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
    return { ...old, position_rad: inOrder(all, robot) };
  });
}

/** All joints as given, of those that the robot has and that count. */
export function setPose(movement: Movement, index: number, positions: Positions, robot: Robot): Movement {
  return withKeyframe(movement, index, (old) => ({ ...old, position_rad: poseOf(positions, robot) }));
}

/** A whole pose as keyframes hold it. */
export function poseOf(positions: Positions, robot: Robot): Positions {
  const followers = new Set(robot.mimic_joints.map(({ joint }) => joint));
  const counted = robot.joints.flatMap(({ name, lower_rad, upper_rad }) => {
    const value = positions[name];
    return value === undefined || followers.has(name) ? [] : [[name, normalize(value, lower_rad, upper_rad)] as const];
  });
  return Object.fromEntries(counted);
}

/** Set or take away (`undefined`) what is done at a keyframe. */
export function setAction<D extends ActionKind>(movement: Movement, index: number, deed: D, value: KeyframeActions[D] | undefined): Movement {
  return withKeyframe(movement, index, (old) => {
    const { time_s, position_rad, ...deeds } = old;
    const next: KeyframeActions = { ...deeds };
    if (value === undefined) Reflect.deleteProperty(next, deed);
    else next[deed] = value;
    return { time_s, position_rad, ...actionsOf(next) };
  });
}

/** What is done there, in the order of doing. */
export function actionsOf(keyframe: KeyframeActions): KeyframeActions {
  return Object.fromEntries(ACTION_KINDS.filter((deed) => keyframe[deed] !== undefined).map((deed) => [deed, keyframe[deed]]));
}

export function hasAction(keyframe: KeyframeActions): boolean {
  return ACTION_KINDS.some((deed) => keyframe[deed] !== undefined);
}

/** A keyframe in time: between its neighbours, or with all that follows (`shifting`). The first one is at 0. */
export function setTime(movement: Movement, index: number, time: number, shifting: boolean): Movement {
  const { keyframes } = movement;
  const before = keyframes[index - 1];
  const old = keyframes[index];
  if (before === undefined || old === undefined || !Number.isFinite(time)) return movement;
  const after = shifting ? undefined : keyframes[index + 1];
  const latest = shifting ? LONGEST_S - ((keyframes.at(-1)?.time_s ?? 0) - old.time_s) : (after?.time_s ?? LONGEST_S + SHORTEST_S) - SHORTEST_S;
  const moved = tidyTime(clamp(time, before.time_s + SHORTEST_S, Math.max(latest, before.time_s + SHORTEST_S)));
  const shift = moved - old.time_s;
  return {
    ...movement,
    keyframes: keyframes.map((one, other) => {
      if (other === index) return { ...one, time_s: moved };
      return shifting && other > index ? { ...one, time_s: tidyTime(one.time_s + shift) } : one;
    }),
  };
}

/** A keyframe after another one: in the middle of what follows, or a second later. It names what that one names. */
export function addAfter(movement: Movement, index: number, positions: Positions): Movement {
  const { keyframes } = movement;
  const [old, after] = [keyframes[index], keyframes[index + 1]];
  if (old === undefined) return movement;
  const time_s = tidyTime(after === undefined ? old.time_s + 1 : (old.time_s + after.time_s) / 2);
  const added: Keyframe = { time_s, position_rad: positions };
  const room = after === undefined || after.time_s - old.time_s >= 2 * SHORTEST_S;
  const next = { ...movement, keyframes: keyframes.toSpliced(index + 1, 0, added) };
  return room ? next : setTime(next, index + 1, old.time_s + 1, true);
}

/** The same once more, a second later, with all that follows. */
export function duplicate(movement: Movement, index: number): Movement {
  const old = movement.keyframes[index];
  if (old === undefined) return movement;
  const next = { ...movement, keyframes: movement.keyframes.toSpliced(index + 1, 0, { ...old }) };
  return setTime(next, index + 1, old.time_s + 1, true);
}

/** Without a keyframe; there is always one. */
export function remove(movement: Movement, index: number): Movement {
  if (movement.keyframes.length < 2) return movement;
  return startAtZero({ ...movement, keyframes: movement.keyframes.toSpliced(index, 1) });
}

/** The first keyframe at 0. */
export function startAtZero(movement: Movement): Movement {
  const begin = movement.keyframes[0]?.time_s ?? 0;
  return {
    ...movement,
    keyframes: movement.keyframes.map((one) => ({ ...one, time_s: tidyTime(one.time_s - begin) })),
  };
}

function inOrder(positions: Positions, robot: Robot): Positions {
  const known = robot.joints.map(({ name }) => name).filter((name) => name in positions);
  const others = Object.keys(positions).filter((name) => !known.includes(name));
  return Object.fromEntries([...known, ...others].map((name) => [name, positions[name] ?? NaN]));
}

// ---------------------------------------------------------------- how it is played

/** One joint in one piece of the movement: from where it rests to where it rests again. */
interface Track {
  joint: Joint;
  stays: Stay[];
}

interface Piece {
  /** Indices of the keyframes where it begins and ends. */
  first: number;
  last: number;
  gaps: number[];
  tracks: Track[];
}

function pieces(keyframes: readonly Keyframe[], robot: Robot): Piece[] {
  const found: Piece[] = [];
  const rests = new Map<string, number>();
  const followers = new Set(robot.mimic_joints.map(({ joint }) => joint));
  for (const joint of robot.joints) {
    // Where a joint is before it is named first nobody knows; it is drawn where it is named first.
    const named = keyframes.find(({ position_rad }) => joint.name in position_rad);
    const place = named?.position_rad[joint.name];
    if (place !== undefined && !followers.has(joint.name)) rests.set(joint.name, place);
  }
  for (let first = 0; first < keyframes.length - 1; ) {
    let last = first + 1;
    while (last < keyframes.length - 1 && !hasAction(keyframes[last] ?? {})) last += 1;
    const stretch = keyframes.slice(first, last + 1);
    const gaps = stretch.slice(1).map(({ time_s }, index) => Math.max(time_s - (stretch[index]?.time_s ?? 0), 1e-3));
    const tracks = robot.joints.flatMap((joint) => {
      const rest = rests.get(joint.name);
      if (rest === undefined) return [];
      const stays: Stay[] = [{ number: 0, place: rest }];
      stretch.slice(1).forEach(({ position_rad }, index) => {
        const place = position_rad[joint.name];
        if (place !== undefined) stays.push({ number: index + 1, place });
      });
      rests.set(joint.name, stays.at(-1)?.place ?? rest);
      return [{ joint, stays }];
    });
    found.push({ first, last, gaps, tracks });
    first = last;
  }
  return found;
}

/** What the robot will do, and when. */
export interface Plan {
  /** Where time would be at each keyframe if the robot played it now [s]: later than asked where that is too fast. */
  reached_s: number[];
  duration_s: number;
  /** Where joints are at a time of `reached_s` [rad]. */
  at: (time: number) => Positions;
  /** That time on the scale of the keyframes' own times [s]. */
  asked: (time: number) => number;
  /** The other way round. */
  played: (asked: number) => number;
}

export function plan({ keyframes }: Movement, robot: Robot): Plan {
  const reached = [0];
  /** The two scales side by side: where something is done one of them stands still. */
  const scale: [played: number, asked: number][] = [[0, 0]];
  const parts: { begin: number; end: number; curves: [string, Curve][] }[] = [];
  let begin = hasAction(keyframes[0] ?? {}) ? DEED_S : 0;
  for (const piece of pieces(keyframes, robot)) {
    const times = moments(fitted(piece.gaps, piece.tracks));
    parts.push({
      begin,
      end: begin + (times.at(-1) ?? 0),
      curves: piece.tracks.map(({ joint, stays }) => [joint.name, curveOf(stays, times)]),
    });
    scale.push([begin, keyframes[piece.first]?.time_s ?? 0]);
    times.slice(1).forEach((time, index) => {
      reached.push(begin + time);
      scale.push([begin + time, keyframes[piece.first + 1 + index]?.time_s ?? 0]);
    });
    begin += (times.at(-1) ?? 0) + (hasAction(keyframes[piece.last] ?? {}) ? DEED_S : 0);
  }
  const only = poseAt(keyframes[0]?.position_rad ?? {}, robot);
  const played = scale.map(([one]) => one);
  const asked = scale.map(([, one]) => one);
  return {
    reached_s: reached,
    duration_s: begin,
    at: (time) => {
      const part = parts.find(({ end }) => time <= end) ?? parts.at(-1);
      if (part === undefined) return only;
      return poseAt(Object.fromEntries(part.curves.map(([name, curve]) => [name, curve.at(time - part.begin)])), robot);
    },
    asked: (time) => between(time, played, asked),
    played: (time) => between(time, asked, played),
  };
}

/** A value on one scale from that on another; beyond their ends that of the ends. */
function between(value: number, from: readonly number[], to: readonly number[]): number {
  const end = from.findIndex((one) => one > value);
  if (end === 0) return at(to, 0);
  if (end < 0) return at(to, to.length - 1);
  const share = (value - at(from, end - 1)) / (at(from, end) - at(from, end - 1));
  return at(to, end - 1) + share * (at(to, end) - at(to, end - 1));
}

/** Joints that hang together as they do: the range that narrows, and those that one motor moves. */
export function poseAt(positions: Positions, robot: Robot): Positions {
  const all: Record<string, number> = { ...positions };
  for (const { joint, depends_on, table } of robot.position_dependent_limits) {
    const [place, where] = [all[joint], all[depends_on]];
    if (place === undefined || where === undefined) continue;
    const [lower, upper] = room(table, where);
    all[joint] = clamp(place, lower, upper);
  }
  for (const { joint, mimics, multiplier } of robot.mimic_joints) {
    const leads = all[mimics];
    if (leads !== undefined) all[joint] = leads * multiplier;
  }
  return all;
}

/** The range that is left where the other joint is. */
function room(table: KnownDescription["position_dependent_limits"][number]["table"], where: number): [number, number] {
  const by = table.map((row) => row[0]);
  return [1, 2].map((column) => between(where, by, table.map((row) => row[column] ?? NaN))) as [number, number];
}

// ---------------------------------------------------------------- checks

/** What is wrong at one keyframe, and what mends it. A `warning` runs all the same. */
export interface Problem {
  severity: "error" | "warning";
  keyframe: number;
  /** Joint's name, where one is meant. */
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

/** Where a joint is at a keyframe [rad]: as it says, or on the way between those that do; `undefined`: none does. */
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

/** Whether a robot can do such a thing at a keyframe, by its own description. */
export function supports(robot: Robot, deed: ActionKind): boolean {
  return robot.actions.includes(ACTIONS[deed]);
}

/** Joints whose beginning nobody knows: the robot begins them from wherever it is. */
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
  /** How long it must take in all, and takes [s]. */
  over: number;
  lasts_s: number;
}

/** What is fastest of all that ends at a keyframe, by its index. */
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

/** With so much more time before a keyframe that all that ends there is slow enough. */
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

/** With as much time everywhere as the robot's limits ask for. */
export function stretchAll(movement: Movement, robot: Robot): Movement {
  let now = movement;
  for (let tries = 0; tries < 20; tries += 1) {
    const all = [...fastest(now, robot).keys()].sort((a, b) => a - b);
    if (all.length === 0) break;
    for (const keyframe of all) now = slowed(now, keyframe, robot);
  }
  return now;
}
