/** Columns for a line chart. A gap contains a null, so that no line crosses it. */
import { degrees } from "../../../../shared/lib/angles";
import { gapOf, type Samples } from "./samples";

export interface PlotColumns {
  time_s: number[];
  /** One column for each joint [°]. null: a gap; undefined: no value at this time, the line continues. */
  solid: (number | null | undefined)[][];
  dashed: (number | null | undefined)[][];
}

/** Distance of the null from the last sample before a gap [s]. */
const AFTER_S = 1e-6;
/** Times of two sessions that differ by less are equal [s]. */
const SAME_S = 1e-9;

/** Measured positions as solid and applied ones as dashed lines. `pieces`: in order of time. `joints`: indices of the joints to draw. */
export function plotColumns(pieces: readonly Samples[], joints: readonly number[]): PlotColumns {
  const columns: PlotColumns = { time_s: [], solid: joints.map(() => []), dashed: joints.map(() => []) };
  let last = -Infinity;
  let gap_s = 0;
  for (const samples of pieces) {
    gap_s = Math.max(gap_s, gapOf(samples));
    for (let index = 0; index < samples.time_s.length; index += 1) {
      const time = samples.time_s[index] ?? NaN;
      if (time - last > gap_s && Number.isFinite(last)) add(columns, last + AFTER_S, null, joints, index);
      add(columns, time, samples, joints, index);
      last = time;
      gap_s = gapOf(samples);
    }
  }
  return columns;
}

function add(columns: PlotColumns, time: number, samples: Samples | null, joints: readonly number[], index: number): void {
  columns.time_s.push(time);
  joints.forEach((joint, column) => {
    const at = samples === null ? -1 : index * samples.joints.length + joint;
    columns.solid[column]?.push(inDegrees(samples?.position_rad[at]));
    columns.dashed[column]?.push(inDegrees(samples?.applied_rad[at]));
  });
}

function inDegrees(value: number | undefined): number | null {
  return value === undefined || Number.isNaN(value) ? null : degrees(value);
}

/** Measured positions of two sessions: those of the second as dashed lines. `offset_s`: time in the second minus the time in the first. */
export function comparedColumns(first: PlotColumns, second: PlotColumns, offset_s: number): PlotColumns {
  const merged: PlotColumns = { time_s: [], solid: first.solid.map(() => []), dashed: first.solid.map(() => []) };
  let [one, other] = [0, 0];
  while (one < first.time_s.length || other < second.time_s.length) {
    const [at, otherAt] = [first.time_s[one] ?? Infinity, (second.time_s[other] ?? Infinity) - offset_s];
    const [takesOne, takesOther] = [at <= otherAt + SAME_S, otherAt <= at + SAME_S];
    merged.time_s.push(Math.min(at, otherAt));
    merged.solid.forEach((column, joint) => column.push(takesOne ? first.solid[joint]?.[one] : undefined));
    merged.dashed.forEach((column, joint) => column.push(takesOther ? second.solid[joint]?.[other] : undefined));
    one += takesOne ? 1 : 0;
    other += takesOther ? 1 : 0;
  }
  return merged;
}
