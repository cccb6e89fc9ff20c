/** A line chart of joint positions over the visible part of a recording. Loaded on demand. */
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { colour } from "../../../shared/ui/canvas-theme";
import type { PlotColumns, Range } from "../model/recording";
import { texts } from "./texts";
import { TIME_STEPS_S } from "./timeline-canvas";

export interface PositionChart {
  /** Different for each chart. */
  id: number;
  /** Draws the visible part. `columns` null: the data is unchanged. */
  draw(columns: PlotColumns | null, range: Range): void;
  dispose(): void;
}

/** Width of the axis on the left, as in `--axis` of the style sheet [px]. */
const AXIS_PX = 56;
/** Width of the longest time [px]. */
const LABEL_PX = 56;
/** Smaller ranges are noise and drawn as a flat line [°]. */
const SMALLEST_RANGE = 2;
let charts = 0;

/** `colours`: of each joint. */
export function createPositionChart(box: HTMLElement, colours: readonly string[]): PositionChart {
  const axis = { stroke: colour("--quiet"), grid: { stroke: colour("--line"), width: 1 }, ticks: { stroke: colour("--line"), width: 1 } };
  const line = { width: 1.5, points: { show: false } };
  const chart = new uPlot(
    {
      width: Math.max(1, box.clientWidth),
      height: Math.max(1, box.clientHeight),
      padding: [8, 0, 0, 0],
      legend: { show: false },
      cursor: { show: false },
      scales: { x: { time: false }, y: { range: (_, low, high) => padded(low, high) } },
      axes: [
        { ...axis, space: 76, incrs: [...TIME_STEPS_S], values: timeLabels },
        { ...axis, size: AXIS_PX, values: (_, ticks) => ticks.map((tick) => `${tick}${texts.plot.unit}`) },
      ],
      series: [
        {},
        ...colours.map((stroke) => ({ ...line, stroke })),
        ...colours.map((stroke) => ({ ...line, stroke, dash: [5, 4] })),
      ],
    },
    [[], ...colours.map(() => []), ...colours.map(() => [])],
    box,
  );
  const observer = new ResizeObserver(() => {
    if (box.clientWidth > 0) chart.setSize({ width: box.clientWidth, height: box.clientHeight });
  });
  observer.observe(box);
  charts += 1;
  return {
    id: charts,
    draw(columns, { from_s: min, to_s: max }) {
      chart.batch(() => {
        if (columns !== null) chart.setData([columns.time_s, ...columns.solid, ...columns.dashed], false);
        chart.setScale("x", { min, max });
      });
    },
    dispose() {
      observer.disconnect();
      chart.destroy();
    },
  };
}

/** Times on the axis. The chart has no room on the right for half of a label. */
function timeLabels(plot: uPlot, ticks: number[]): string[] {
  const digits = (ticks[1] ?? 1) - (ticks[0] ?? 0) < 1 ? 1 : 0;
  const right = plot.valToPos(plot.scales["x"]?.max ?? 0, "x") - LABEL_PX / 2;
  return ticks.map((tick) => (plot.valToPos(tick, "x") > right ? "" : texts.clock(tick, digits)));
}

function padded(low: number | null, high: number | null): [number, number] {
  // Without a value uPlot passes nulls.
  const [from, to] = [low ?? -1, high ?? 1];
  const pad = Math.max((SMALLEST_RANGE - (to - from)) / 2, (to - from) * 0.08);
  return [from - pad, to + pad];
}
