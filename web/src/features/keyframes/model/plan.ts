/** The timed joint positions of a movement. */
import { clamp } from "../../../shared/lib/angles";
import type { KnownDescription } from "../../../shared/mqtt/parse-messages";
import type { Joint } from "../../../shared/mqtt/protocol.generated";
import { at, Curve, curveOf, extendGaps, timesOf, type Waypoint } from "./timeline-layout";
import { type Positions, type Keyframe, type Movement, type Robot, ACTION_PREVIEW_S, hasAction } from "./keyframes";

/** Waypoints of one joint. It is at rest at the first and at the last one. */
interface Track {
  joint: Joint;
  waypoints: Waypoint[];
}

interface Segment {
  /** Indices of the first and last keyframe. */
  first: number;
  last: number;
  gaps: number[];
  tracks: Track[];
}

export function segmentsOf(keyframes: readonly Keyframe[], robot: Robot): Segment[] {
  const segments: Segment[] = [];
  const lastPositions = new Map<string, number>();
  const followers = new Set(robot.mimic_joints.map(({ joint }) => joint));
  for (const joint of robot.joints) {
    // A joint's position before its first keyframe is unknown; draw it at its first known position.
    const named = keyframes.find(({ position_rad }) => joint.name in position_rad);
    const position = named?.position_rad[joint.name];
    if (position !== undefined && !followers.has(joint.name)) lastPositions.set(joint.name, position);
  }
  for (let first = 0; first < keyframes.length - 1; ) {
    let last = first + 1;
    while (last < keyframes.length - 1 && !hasAction(keyframes[last] ?? {})) last += 1;
    const keyframesOfSegment = keyframes.slice(first, last + 1);
    const gaps = keyframesOfSegment.slice(1).map(({ time_s }, index) => Math.max(time_s - (keyframesOfSegment[index]?.time_s ?? 0), 1e-3));
    const tracks = robot.joints.flatMap((joint) => {
      const lastPosition = lastPositions.get(joint.name);
      if (lastPosition === undefined) return [];
      const waypoints: Waypoint[] = [{ index: 0, position: lastPosition }];
      keyframesOfSegment.slice(1).forEach(({ position_rad }, index) => {
        const position = position_rad[joint.name];
        if (position !== undefined) waypoints.push({ index: index + 1, position });
      });
      lastPositions.set(joint.name, waypoints.at(-1)?.position ?? lastPosition);
      return [{ joint, waypoints }];
    });
    segments.push({ first, last, gaps, tracks });
    first = last;
  }
  return segments;
}

interface Plan {
  /** When the robot would reach each keyframe [s]. Later than specified if the limits require it. */
  reached_s: number[];
  duration_s: number;
  /** Joint positions at a time of `reached_s` [rad]. */
  at: (time: number) => Positions;
  /** Converts that time to the scale of the keyframes [s]. */
  keyframeTime: (time: number) => number;
  /** The inverse of `keyframeTime`. */
  previewTime: (keyframeTime: number) => number;
}

export function plan({ keyframes }: Movement, robot: Robot): Plan {
  const reached = [0];
  /** Corresponding times on both scales: the keyframe time pauses during an action. */
  const scale: [previewTime: number, keyframeTime: number][] = [[0, 0]];
  const parts: { begin: number; end: number; curves: [string, Curve][] }[] = [];
  let begin = hasAction(keyframes[0] ?? {}) ? ACTION_PREVIEW_S : 0;
  for (const segment of segmentsOf(keyframes, robot)) {
    const times = timesOf(extendGaps(segment.gaps, segment.tracks));
    parts.push({
      begin,
      end: begin + (times.at(-1) ?? 0),
      curves: segment.tracks.map(({ joint, waypoints }) => [joint.name, curveOf(waypoints, times)]),
    });
    scale.push([begin, keyframes[segment.first]?.time_s ?? 0]);
    times.slice(1).forEach((time, index) => {
      reached.push(begin + time);
      scale.push([begin + time, keyframes[segment.first + 1 + index]?.time_s ?? 0]);
    });
    begin += (times.at(-1) ?? 0) + (hasAction(keyframes[segment.last] ?? {}) ? ACTION_PREVIEW_S : 0);
  }
  const singlePose = poseAt(keyframes[0]?.position_rad ?? {}, robot);
  const previewTime = scale.map(([one]) => one);
  const keyframeTime = scale.map(([, one]) => one);
  return {
    reached_s: reached,
    duration_s: begin,
    at: (time) => {
      const part = parts.find(({ end }) => time <= end) ?? parts.at(-1);
      if (part === undefined) return singlePose;
      return poseAt(Object.fromEntries(part.curves.map(([name, curve]) => [name, curve.at(time - part.begin)])), robot);
    },
    keyframeTime: (time) => mapScale(time, previewTime, keyframeTime),
    previewTime: (time) => mapScale(time, keyframeTime, previewTime),
  };
}

/** Maps a value from one scale to another, clamped to their ends. */
function mapScale(value: number, from: readonly number[], to: readonly number[]): number {
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
    const [position, otherPosition] = [all[joint], all[depends_on]];
    if (position === undefined || otherPosition === undefined) continue;
    const [lower, upper] = rangeAt(table, otherPosition);
    all[joint] = clamp(position, lower, upper);
  }
  for (const { joint, mimics, multiplier } of robot.mimic_joints) {
    const leaderPosition = all[mimics];
    if (leaderPosition !== undefined) all[joint] = leaderPosition * multiplier;
  }
  return all;
}

/** The range that remains at a position of the other joint. */
export function rangeAt(table: KnownDescription["position_dependent_limits"][number]["table"], otherPosition: number): [number, number] {
  const by = table.map((row) => row[0]);
  return [1, 2].map((column) => mapScale(otherPosition, by, table.map((row) => row[column] ?? NaN))) as [number, number];
}
