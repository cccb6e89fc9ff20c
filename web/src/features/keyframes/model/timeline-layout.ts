/**
 * Joint positions between keyframes, computed as in `device_agent/runtime/planning/keyframe_trajectory.py`;
 * `tests/unit/device_agent/runtime/planning/timelines.json` verifies both. Quintic polynomials without acceleration at
 * keyframes. The velocity at a keyframe is the harmonic mean of the adjacent mean velocities, so that motion never
 * reverses.
 */
import { clamp } from "../../../shared/lib/angles";
import type { Joint } from "../../../shared/mqtt/protocol.generated";

type JointLimits = Pick<Joint, "max_velocity_rad_s" | "max_acceleration_rad_s2" | "max_jerk_rad_s3">;

/** A joint's position [rad] at a keyframe. */
export interface Stay {
  number: number;
  place: number;
}

export type Limiting = "velocity" | "acceleration" | "jerk";

interface Stretch {
  /** Required time relative to the available time; up to 1 is feasible. */
  over: number;
  by: Limiting;
}

/** Tolerance for rounding. */
export const FITS = 1.0005;
const LOOKS = 33;
const TRIES = 100;

type Parts = readonly [way: number, begin: number, end: number];

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

const LOOK = Array.from({ length: LOOKS }, (_, index) => shape(index / (LOOKS - 1)));

function sum(row: Parts | undefined, parts: Parts): number {
  return row === undefined ? 0 : row[0] * parts[0] + row[1] * parts[1] + row[2] * parts[2];
}

/** One joint's curve through its positions. It rests before and after it. */
export class Curve {
  readonly times: readonly number[];
  readonly places: readonly number[];
  readonly #speeds: readonly number[];

  constructor(times: readonly number[], places: readonly number[]) {
    this.times = times;
    this.places = places;
    const slopes = places.slice(1).map((place, index) => (place - at(places, index)) / (at(times, index + 1) - at(times, index)));
    this.#speeds = places.map((_, index) => {
      const [before, after] = [slopes[index - 1] ?? 0, slopes[index] ?? 0];
      return before * after > 0 ? (2 * before * after) / (before + after) : 0;
    });
  }

  /** The position at a time [rad]. */
  at(time: number): number {
    const end = this.times.findIndex((one) => one > time);
    if (end === 0) return at(this.places, 0);
    if (end < 0) return at(this.places, this.places.length - 1);
    const [from, to] = [at(this.places, end - 1), at(this.places, end)];
    const lasts = at(this.times, end) - at(this.times, end - 1);
    const row = shape((time - at(this.times, end - 1)) / lasts)[0];
    return clamp(from + sum(row, this.#parts(end)), Math.min(from, to), Math.max(from, to));
  }

  /** The demand of each segment on a joint; the first segment ends at the second position. */
  stretches(joint: JointLimits): Stretch[] {
    return this.places.slice(1).map((_, index) => this.#stretch(index + 1, joint));
  }

  #stretch(end: number, joint: JointLimits): Stretch {
    const parts = this.#parts(end);
    const lasts = at(this.times, end) - at(this.times, end - 1);
    const most = (order: number): number => Math.max(...LOOK.map((rows) => Math.abs(sum(rows[order], parts)))) / lasts ** order;
    const all: Stretch[] = [
      { by: "velocity", over: most(1) / joint.max_velocity_rad_s },
      { by: "acceleration", over: Math.sqrt(most(2) / joint.max_acceleration_rad_s2) },
      { by: "jerk", over: Math.cbrt(most(3) / joint.max_jerk_rad_s3) },
    ];
    return all.reduce((worst, one) => (one.over > worst.over ? one : worst));
  }

  #parts(end: number): Parts {
    const lasts = at(this.times, end) - at(this.times, end - 1);
    const way = at(this.places, end) - at(this.places, end - 1);
    return [way, at(this.#speeds, end - 1) * lasts, at(this.#speeds, end) * lasts];
  }
}

export function at(list: readonly number[], index: number): number {
  return list[index] ?? NaN;
}

/** Times from the gaps between them. */
export function moments(gaps: readonly number[]): number[] {
  const found = [0];
  for (const gap of gaps) found.push((found.at(-1) ?? 0) + gap);
  return found;
}

export function curveOf(stays: readonly Stay[], times: readonly number[]): Curve {
  return new Curve(
    stays.map(({ number }) => at(times, number)),
    stays.map(({ place }) => place),
  );
}

/**
 * The gaps between keyframes [s], extended where the limits require it. Extending one changes the velocity in others,
 * so this iterates.
 */
export function fitted(gaps: readonly number[], tracks: readonly { joint: JointLimits; stays: readonly Stay[] }[]): number[] {
  let now = [...gaps];
  let longest = 1;
  for (let tries = 0; tries < TRIES; tries += 1) {
    const longer = now.map(() => 1);
    const times = moments(now);
    for (const { joint, stays } of tracks) {
      curveOf(stays, times)
        .stretches(joint)
        .forEach(({ over }, index) => {
          const [begin, end] = [stays[index]?.number ?? 0, stays[index + 1]?.number ?? 0];
          for (let gap = begin; gap < end; gap += 1) longer[gap] = Math.max(at(longer, gap), over);
        });
    }
    longest = Math.max(1, ...longer);
    if (longest <= FITS) return now;
    now = now.map((gap, index) => gap * at(longer, index));
  }
  return now.map((gap) => gap * longest);
}
