/** Figures that compare two sessions, from their overviews: five samples a second. */
import { gapOf, indexAt, type Samples, SOURCES, type Source } from "../samples";

export interface JointDifference {
  joint: string;
  /** Root mean square of the difference of the positions over the overlap [rad]. */
  rms_rad: number;
  max_rad: number;
  /** Where the difference is largest, in the first session [s]. */
  max_at_s: number;
}

/** `overlap_s`: time in which both sessions have samples [s]. Without an overlap there are no joints. */
export interface Differences {
  overlap_s: number;
  joints: readonly JointDifference[];
}

export interface SessionFigures {
  /** Time with samples [s]. */
  recorded_s: number;
  /** Way of each joint, in the order of the joints [rad]. */
  path_rad: readonly number[];
  /** Part of the time with samples, by what caused the motion. */
  shares: Readonly<Record<Source, number>>;
  /** How often Stop was latched, and how often the device had a fault. */
  stops: number;
  faults: number;
}

const FAULT_MODE = 5;

/** `offset_s`: time in the second session minus the time in the first one. Pieces are in order of time. */
export function differencesOf(first: readonly Samples[], second: readonly Samples[], offset_s: number): Differences {
  const joints = first[0]?.joints ?? [];
  const sums = joints.map((joint) => ({ joint, squares: 0, max_rad: 0, max_at_s: 0 }));
  let [count, overlap_s] = [0, 0];
  for (const samples of first) {
    for (const [index, time_s] of samples.time_s.entries()) {
      const found = positionsAt(second, time_s + offset_s);
      if (found === null) continue;
      count += 1;
      overlap_s += samples.period_s;
      sums.forEach((sum, joint) => {
        const difference = Math.abs((samples.position_rad[index * joints.length + joint] ?? NaN) - (found[joint] ?? NaN));
        if (Number.isNaN(difference)) return;
        sum.squares += difference ** 2;
        if (difference > sum.max_rad) [sum.max_rad, sum.max_at_s] = [difference, time_s];
      });
    }
  }
  if (count === 0) return { overlap_s: 0, joints: [] };
  return { overlap_s, joints: sums.map(({ squares, ...rest }) => ({ ...rest, rms_rad: Math.sqrt(squares / count) })) };
}

/** The positions at a time, between two samples; null in a gap. */
function positionsAt(pieces: readonly Samples[], at_s: number): readonly number[] | null {
  const number = pieces.findLastIndex(({ time_s }) => (time_s[0] ?? Infinity) <= at_s);
  const samples = pieces[number];
  if (samples === undefined) return null;
  const index = indexAt(samples.time_s, at_s);
  const before = place(samples, index);
  const next = pieces[number + 1];
  const after = place(samples, index + 1) ?? (next === undefined ? null : place(next, 0));
  if (before === null || at_s - before.time_s > gapOf(samples)) return null;
  // The last sample before a gap is valid for its period.
  if (after === null || after.time_s - before.time_s > gapOf(samples)) return at_s - before.time_s <= samples.period_s ? before.position_rad : null;
  const part = (at_s - before.time_s) / (after.time_s - before.time_s);
  return before.position_rad.map((value, joint) => value + part * ((after.position_rad[joint] ?? NaN) - value));
}

function place({ joints, time_s, position_rad }: Samples, index: number): { time_s: number; position_rad: readonly number[] } | null {
  const found = time_s[index];
  return found === undefined ? null : { time_s: found, position_rad: Array.from(position_rad.subarray(index * joints.length, (index + 1) * joints.length)) };
}

export function figuresOf(pieces: readonly Samples[]): SessionFigures {
  const path = (pieces[0]?.joints ?? []).map(() => 0);
  const times: Record<Source, number> = { operator: 0, movement: 0, hold: 0, stop: 0 };
  let [recorded_s, stops, faults] = [0, 0, 0];
  let last: { samples: Samples; index: number } | null = null;
  for (const samples of pieces) {
    for (const [index, time_s] of samples.time_s.entries()) {
      const joined: { samples: Samples; index: number } | null = last !== null && time_s - (last.samples.time_s[last.index] ?? NaN) <= gapOf(samples) ? last : null;
      const source = SOURCES[samples.source[index] ?? -1] ?? "hold";
      recorded_s += samples.period_s;
      times[source] += samples.period_s;
      if (source === "stop" && (last === null || SOURCES[last.samples.source[last.index] ?? -1] !== "stop")) stops += 1;
      if (samples.mode[index] === FAULT_MODE && last?.samples.mode[last.index] !== FAULT_MODE) faults += 1;
      if (joined !== null) addWay(path, joined, { samples, index });
      last = { samples, index };
    }
  }
  const share = (time: number): number => (recorded_s === 0 ? 0 : time / recorded_s);
  const shares = { operator: share(times.operator), movement: share(times.movement), hold: share(times.hold), stop: share(times.stop) };
  return { recorded_s, path_rad: path, shares, stops, faults };
}

function addWay(path: number[], from: { samples: Samples; index: number }, to: { samples: Samples; index: number }): void {
  const value = ({ samples, index }: typeof from, joint: number): number => samples.position_rad[index * samples.joints.length + joint] ?? NaN;
  path.forEach((_, joint) => {
    const way = Math.abs(value(to, joint) - value(from, joint));
    if (!Number.isNaN(way)) path[joint] = (path[joint] ?? 0) + way;
  });
}
