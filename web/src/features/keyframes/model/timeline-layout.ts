/**
 * Joint positions between keyframes, computed as in `device_agent/runtime/planning/keyframe_trajectory.py`;
 * `tests/unit/device_agent/runtime/planning/timelines.json` verifies both. Quintic polynomials without acceleration at
 * keyframes. The velocity at a keyframe is the harmonic mean of the adjacent mean velocities, so that motion never
 * reverses.
 */
import { clamp } from "../../../shared/lib/angles";
import type { Joint } from "../../../shared/mqtt/protocol.generated";

type JointLimits = Pick<Joint, "max_velocity_rad_s" | "max_acceleration_rad_s2" | "max_jerk_rad_s3">;

/** A joint's position [rad] at the keyframe `index`. */
export interface Waypoint {
  index: number;
  position: number;
}

export type Limiting = "velocity" | "acceleration" | "jerk";

interface SegmentDemand {
  /** Required time relative to the available time; up to 1 is feasible. */
  timeRatio: number;
  by: Limiting;
}

/** Feasible up to 1; the rest is a rounding tolerance. */
export const MAX_TIME_RATIO = 1.0005;
const SAMPLE_COUNT = 33;
const MAX_ITERATIONS = 100;

type Parts = readonly [distance: number, begin: number, end: number];

/** Rows: position, velocity, acceleration, jerk; columns: factors of the distance, the start and the end velocity. */
function shape(u: number): readonly Parts[] {
  const [u2, u3, u4] = [u * u, u ** 3, u ** 4];
  return [
    [10 * u3 - 15 * u4 + 6 * u4 * u, u - 6 * u3 + 8 * u4 - 3 * u4 * u, -4 * u3 + 7 * u4 - 3 * u4 * u],
    [30 * u2 - 60 * u3 + 30 * u4, 1 - 18 * u2 + 32 * u3 - 15 * u4, -12 * u2 + 28 * u3 - 15 * u4],
    [60 * u - 180 * u2 + 120 * u3, -36 * u + 96 * u2 - 60 * u3, -24 * u + 84 * u2 - 60 * u3],
    [60 - 360 * u + 360 * u2, -36 + 192 * u - 180 * u2, -24 + 168 * u - 180 * u2],
  ];
}

const SAMPLED_SHAPES = Array.from({ length: SAMPLE_COUNT }, (_, index) => shape(index / (SAMPLE_COUNT - 1)));

function sum(row: Parts | undefined, parts: Parts): number {
  return row === undefined ? 0 : row[0] * parts[0] + row[1] * parts[1] + row[2] * parts[2];
}

/** One joint's curve through its positions. The joint is at rest before and after the curve. */
export class Curve {
  readonly times: readonly number[];
  readonly positions: readonly number[];
  readonly #speeds: readonly number[];

  constructor(times: readonly number[], positions: readonly number[]) {
    this.times = times;
    this.positions = positions;
    const slopes = positions.slice(1).map((position, index) => (position - at(positions, index)) / (at(times, index + 1) - at(times, index)));
    this.#speeds = positions.map((_, index) => {
      const [before, after] = [slopes[index - 1] ?? 0, slopes[index] ?? 0];
      return before * after > 0 ? (2 * before * after) / (before + after) : 0;
    });
  }

  /** The position at a time [rad]. */
  at(time: number): number {
    const end = this.times.findIndex((one) => one > time);
    if (end === 0) return at(this.positions, 0);
    if (end < 0) return at(this.positions, this.positions.length - 1);
    const [from, to] = [at(this.positions, end - 1), at(this.positions, end)];
    const duration_s = at(this.times, end) - at(this.times, end - 1);
    const row = shape((time - at(this.times, end - 1)) / duration_s)[0];
    return clamp(from + sum(row, this.#parts(end)), Math.min(from, to), Math.max(from, to));
  }

  /** The demand of each segment on a joint; the first segment ends at the second position. */
  segmentDemands(joint: JointLimits): SegmentDemand[] {
    return this.positions.slice(1).map((_, index) => this.#demand(index + 1, joint));
  }

  #demand(end: number, joint: JointLimits): SegmentDemand {
    const parts = this.#parts(end);
    const duration_s = at(this.times, end) - at(this.times, end - 1);
    const peak = (order: number): number => Math.max(...SAMPLED_SHAPES.map((rows) => Math.abs(sum(rows[order], parts)))) / duration_s ** order;
    const all: SegmentDemand[] = [
      { by: "velocity", timeRatio: peak(1) / joint.max_velocity_rad_s },
      { by: "acceleration", timeRatio: Math.sqrt(peak(2) / joint.max_acceleration_rad_s2) },
      { by: "jerk", timeRatio: Math.cbrt(peak(3) / joint.max_jerk_rad_s3) },
    ];
    return all.reduce((worst, one) => (one.timeRatio > worst.timeRatio ? one : worst));
  }

  #parts(end: number): Parts {
    const duration_s = at(this.times, end) - at(this.times, end - 1);
    const distance = at(this.positions, end) - at(this.positions, end - 1);
    return [distance, at(this.#speeds, end - 1) * duration_s, at(this.#speeds, end) * duration_s];
  }
}

export function at(list: readonly number[], index: number): number {
  return list[index] ?? NaN;
}

/** Times from the gaps between them. */
export function timesOf(gaps: readonly number[]): number[] {
  const found = [0];
  for (const gap of gaps) found.push((found.at(-1) ?? 0) + gap);
  return found;
}

export function curveOf(waypoints: readonly Waypoint[], times: readonly number[]): Curve {
  return new Curve(
    waypoints.map(({ index }) => at(times, index)),
    waypoints.map(({ position }) => position),
  );
}

/**
 * The gaps between keyframes [s], extended where the limits require it. Extending one changes the velocity in others,
 * so this iterates.
 */
export function extendGaps(gaps: readonly number[], tracks: readonly { joint: JointLimits; waypoints: readonly Waypoint[] }[]): number[] {
  let extended = [...gaps];
  let largestFactor = 1;
  for (let iteration = 0; iteration < MAX_ITERATIONS; iteration += 1) {
    const factors = extended.map(() => 1);
    const times = timesOf(extended);
    for (const { joint, waypoints } of tracks) {
      curveOf(waypoints, times)
        .segmentDemands(joint)
        .forEach(({ timeRatio }, index) => {
          const [begin, end] = [waypoints[index]?.index ?? 0, waypoints[index + 1]?.index ?? 0];
          for (let gap = begin; gap < end; gap += 1) factors[gap] = Math.max(at(factors, gap), timeRatio);
        });
    }
    largestFactor = Math.max(1, ...factors);
    if (largestFactor <= MAX_TIME_RATIO) return extended;
    extended = extended.map((gap, index) => gap * at(factors, index));
  }
  return extended.map((gap) => gap * largestFactor);
}
