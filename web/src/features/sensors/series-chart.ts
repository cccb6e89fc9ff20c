/** A line chart over time with the room's limits. Loaded on demand. */
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { digits, type Quantity } from "./model/quantities";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { colour } from "../../shared/ui/canvas-theme";

/** Additional drawings. */
export interface Marks {
  /** The usual range in the displayed unit. */
  usual: readonly [low: number, high: number] | null;
  /** Faults on the time axis [s since 1970]; `to` null: open. */
  faults: readonly { from: number; to: number | null; severity: "info" | "warning" | "error" }[];
  /** Cursor position [s since 1970]. */
  cursor: number | null;
}

export interface SeriesChart {
  /** Times [s since 1970]; columns: means, minima, maxima. */
  draw(from: number, to: number, times: number[], columns: (number | null)[][], marks?: Marks): void;
  /** The time at a page coordinate [s since 1970]. */
  timeAt(clientX: number): number;
  dispose(): void;
}

interface Options {
  quantity: Quantity;
  /** A boolean state: 1 is the first of its two labels. */
  binary: boolean;
  colour: string;
}

/** Shows a limit unless it would compress the measured range too much. */
const LIMIT_WITHIN = 12;
/** Smaller changes, relative to the value, are noise and drawn as a flat line. */
const SMALLEST_SHARE = 0.02;
const UNMARKED: Marks = { usual: null, faults: [], cursor: null };
/** Height of the fault strip [px]. */
const STRIP_PX = 6;

export function createSeriesChart(box: HTMLElement, { quantity, binary, colour: line }: Options): SeriesChart {
  const axis = { stroke: colour("--quiet"), grid: { stroke: colour("--line"), width: 1 }, ticks: { stroke: colour("--line"), width: 1 } };
  const stepped = uPlot.paths.stepped?.({ align: 1 });
  let timeRange: [number, number] = [0, 1];
  let marks = UNMARKED;
  const chart = new uPlot(
    {
      width: Math.max(1, box.clientWidth),
      height: Math.max(1, box.clientHeight),
      legend: { show: false },
      cursor: { show: false },
      scales: {
        x: { time: true, range: () => timeRange },
        y: { range: (_, low, high) => (binary ? [-0.15, 1.15] : range(quantity, marks.usual, low, high)) },
      },
      axes: [
        { ...axis, space: 70, values: (_, ticks) => ticks.map((tick) => shortTime(tick, timeRange)) },
        binary
          ? { ...axis, grid: { show: false }, size: 124, splits: () => [0, 1], values: () => stateLabels(quantity.field) }
          : { ...axis, size: (_, values) => axisWidth(values), values: (_, ticks) => ticks.map((tick) => label(tick, ticks, quantity.unit)) },
      ],
      series: [
        {},
        {
          stroke: line,
          width: 1.75,
          points: { show: false },
          ...(binary && stepped !== undefined ? { paths: stepped, fill: `${line}33` } : {}),
        },
        { stroke: "transparent", points: { show: false } },
        { stroke: "transparent", points: { show: false } },
      ],
      ...(binary ? {} : { bands: [{ series: [3, 2] as [number, number], fill: `${line}33` }] }),
      hooks: { drawClear: [(plot) => paintLimits(plot, quantity)], draw: [(plot) => paintMarks(plot, marks)] },
    },
    [[], [], [], []],
    box,
  );
  const observer = new ResizeObserver(() => {
    if (box.clientWidth > 0) chart.setSize({ width: box.clientWidth, height: box.clientHeight });
  });
  observer.observe(box);
  return {
    draw(from, to, times, columns, newMarks = UNMARKED) {
      timeRange = [from, to];
      marks = newMarks;
      const extended = binary && times.length > 0 ? extendToNow(to, times, columns) : { times, columns };
      chart.setData([extended.times, ...extended.columns] as uPlot.AlignedData);
    },
    timeAt: (clientX) => chart.posToVal(clientX - chart.over.getBoundingClientRect().left, "x"),
    dispose() {
      observer.disconnect();
      chart.destroy();
    },
  };
}

/** Extends the last state to now. */
function extendToNow(to: number, times: number[], columns: (number | null)[][]): { times: number[]; columns: (number | null)[][] } {
  return { times: [...times, to], columns: columns.map((column) => [...column, column.at(-1) ?? null]) };
}

function stateLabels(field: string): string[] {
  const [yes, no] = common.booleanState[field] ?? common.yesNo;
  return [no, yes];
}

function range({ limits, toDisplay }: Quantity, usual: Marks["usual"], low: number | null, high: number | null): [number, number] {
  const middle = ((low ?? 0) + (high ?? 0)) / 2;
  const room = Math.max((high ?? 0) - (low ?? 0), SMALLEST_SHARE * Math.abs(middle), 0.1);
  let [from, to] = [Math.min(low ?? 0, middle - room / 2), Math.max(high ?? 1, middle + room / 2)];
  const reach = LIMIT_WITHIN * Math.max(room, 0.15 * Math.abs(middle));
  const warningLimits = [limits?.warning_low, limits?.warning_high].flatMap((limit) => (limit === null || limit === undefined ? [] : [toDisplay(limit)]));
  for (const limit of [...warningLimits, ...(usual ?? [])]) {
    if (Math.abs(limit - middle) <= reach) [from, to] = [Math.min(from, limit), Math.max(to, limit)];
  }
  const pad = (to - from) * 0.08;
  return [low !== null && low >= 0 ? Math.max(0, from - pad) : from - pad, to + pad];
}

function paintLimits(plot: uPlot, { limits, toDisplay }: Quantity): void {
  if (limits === null) return;
  const { ctx, bbox } = plot;
  const { min = NaN, max = NaN } = plot.scales["y"] ?? {};
  if (!(max > min)) return;
  const y = (value: number): number => Math.min(bbox.top + bbox.height, Math.max(bbox.top, plot.valToPos(value, "y", true)));
  const fill = (from: number, to: number, name: string): void => {
    if (to <= from) return;
    ctx.fillStyle = colour(name);
    ctx.fillRect(bbox.left, y(to), bbox.width, y(from) - y(to));
  };
  const limitOr = (value: number | null, otherwise: number): number => (value === null ? otherwise : toDisplay(value));
  const low = limitOr(limits.low, min);
  const high = limitOr(limits.high, max);
  const normalLow = limitOr(limits.warning_low, low);
  const normalHigh = limitOr(limits.warning_high, high);
  if ([limits.low, limits.high, limits.warning_low, limits.warning_high].every((one) => one === null)) return;
  ctx.save();
  fill(Math.max(min, normalLow), Math.min(max, normalHigh), "--good-ground");
  fill(Math.max(min, low), Math.min(max, normalLow), "--warn-ground");
  fill(Math.max(min, normalHigh), Math.min(max, high), "--warn-ground");
  fill(min, Math.min(max, low), "--bad-ground");
  fill(Math.max(min, high), max, "--bad-ground");
  ctx.restore();
}

/** Draws the usual range as two dashed lines, faults as a strip with start lines, and the cursor. */
function paintMarks(plot: uPlot, { usual, faults, cursor }: Marks): void {
  const { ctx, bbox } = plot;
  const right = bbox.left + bbox.width;
  const bottom = bbox.top + bbox.height;
  const ratio = devicePixelRatio;
  const x = (time: number): number => Math.min(right, Math.max(bbox.left, plot.valToPos(time, "x", true)));
  const line = (points: readonly [x: number, y: number][], name: string, dash: number[]): void => {
    ctx.strokeStyle = colour(name);
    ctx.lineWidth = ratio;
    ctx.setLineDash(dash.map((length) => length * ratio));
    ctx.beginPath();
    points.forEach(([px, py], index) => (index === 0 ? ctx.moveTo(px, py) : ctx.lineTo(px, py)));
    ctx.stroke();
  };
  ctx.save();
  for (const value of usual ?? []) {
    const y = plot.valToPos(value, "y", true);
    if (y >= bbox.top && y <= bottom) line([[bbox.left, y], [right, y]], "--quiet", [6, 4]);
  }
  for (const { from, to, severity } of faults) {
    const name = SEVERITY_COLOUR[severity];
    const [begin, end] = [x(from), to === null ? right : x(to)];
    ctx.fillStyle = colour(name);
    ctx.fillRect(begin, bottom - STRIP_PX * ratio, Math.max(end - begin, 2 * ratio), STRIP_PX * ratio);
    if (plot.valToPos(from, "x", true) >= bbox.left) line([[begin, bbox.top], [begin, bottom]], name, [2, 3]);
  }
  if (cursor !== null) line([[x(cursor), bbox.top], [x(cursor), bottom]], "--text", []);
  ctx.restore();
}

const SEVERITY_COLOUR = { info: "--accent", warning: "--warn", error: "--bad" } as const;

/** Width of an axis [px]: its longest label, and at least three digits. */
function axisWidth(values: readonly string[] | null): number {
  const longest = Math.max(0, ...(values ?? []).map((text) => text.length));
  return Math.max(66, 16 + longest * 7.5);
}

function shortTime(tick: number, [from, to]: [number, number]): string {
  const text = format.time(tick * 1000);
  if (to - from > 2 * 86_400) return format.day(tick * 1000);
  return to - from > 1200 ? text.slice(0, 5) : text;
}

function label(tick: number, ticks: readonly number[], unit: string): string {
  const step = Math.abs((ticks[1] ?? 1) - (ticks[0] ?? 0));
  return `${tick.toFixed(step >= 1 ? 0 : digits(step) - 1)} ${unit}`;
}
