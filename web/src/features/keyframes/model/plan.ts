/** The timed joint positions of a movement. */
import { clamp } from "../../../shared/lib/angles";
import type { KnownDescription } from "../../../shared/mqtt/parse-messages";
import type { Joint } from "../../../shared/mqtt/protocol.generated";
import { at, Curve, curveOf, fitted, moments, type Stay } from "./timeline-layout";
import { type Positions, type Keyframe, type Movement, type Robot, DEED_S, hasAction } from "./keyframes";

/** One joint between two poses at which it rests. */
interface Track {
  joint: Joint;
  stays: Stay[];
}

interface Piece {
  /** Indices of the first and last keyframe. */
  first: number;
  last: number;
  gaps: number[];
  tracks: Track[];
}

export function pieces(keyframes: readonly Keyframe[], robot: Robot): Piece[] {
  const found: Piece[] = [];
  const rests = new Map<string, number>();
  const followers = new Set(robot.mimic_joints.map(({ joint }) => joint));
  for (const joint of robot.joints) {
    // A joint's position before its first keyframe is unknown; draw it at its first known position.
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

interface Plan {
  /** When the robot would reach each keyframe [s]: later than requested if that is too fast. */
  reached_s: number[];
  duration_s: number;
  /** Joint positions at a time of `reached_s` [rad]. */
  at: (time: number) => Positions;
  /** Converts that time to the scale of the keyframes [s]. */
  asked: (time: number) => number;
  /** The inverse of `asked`. */
  played: (asked: number) => number;
}

export function plan({ keyframes }: Movement, robot: Robot): Plan {
  const reached = [0];
  /** Corresponding times on both scales: one of them stops during a step. */
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

/** Maps a value from one scale to another, clamped to their ends. */
function between(value: number, from: readonly number[], to: readonly number[]): number {
  const end = from.findIndex((one) => one > value);
  if (end === 0) return at(to, 0);
  if (end < 0) return at(to, to.length - 1);
  const share = (value - at(from, end - 1)) / (at(from, end) - at(from, end - 1));
  return at(to, end - 1) + share * (at(to, end) - at(to, end - 1));
}

/** Applies coupled joints and position-dependent limits. */
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

/** The range that remains at a position of the other joint. */
export function room(table: KnownDescription["position_dependent_limits"][number]["table"], where: number): [number, number] {
  const by = table.map((row) => row[0]);
  return [1, 2].map((column) => between(where, by, table.map((row) => row[column] ?? NaN))) as [number, number];
}
