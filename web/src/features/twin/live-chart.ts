/** A line chart of the last seconds. Loaded on demand. */
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { SPAN_MS } from "./model/recent-telemetry";
import { common } from "../../shared/i18n/common";
import { colour } from "../../shared/ui/canvas-theme";

interface Line {
  label: string;
  colour: string;
  /** The limits in the plot's unit. */
  limits: readonly [number, number];
}

export interface Chart {
  draw(columns: [number[], ...(number | null)[][]]): void;
  dispose(): void;
}

/** A limit is shown unless it is further away than this many times the measured range. */
const LIMIT_WITHIN = 3;
/** Smaller ranges are noise and drawn as a flat line. */
const SMALLEST_RANGE = 2;

export function createChart(box: HTMLElement, lines: readonly Line[], unit: string): Chart {
  const axis = { stroke: colour("--quiet"), grid: { stroke: colour("--line"), width: 1 }, ticks: { stroke: colour("--line"), width: 1 } };
  const chart = new uPlot(
    {
      width: Math.max(1, box.clientWidth),
      height: Math.max(1, box.clientHeight),
      legend: { show: false },
      cursor: { show: false },
      scales: {
        x: { time: false, range: [-SPAN_MS / 1000, 0] },
        y: { range: (_, low, high) => padded(low, high, lines) },
      },
      axes: [
        { ...axis, values: (_, ticks) => ticks.map((tick) => `${tick} ${common.secondsUnit}`) },
        { ...axis, size: 62, values: (_, ticks) => ticks.map((tick) => `${tick} ${unit}`) },
      ],
      series: [
        {},
        ...lines.map((line) => ({ label: line.label, stroke: line.colour, width: 1.75, points: { show: false } })),
      ],
      hooks: { drawClear: [(plot) => paintLimits(plot, lines)] },
    },
    [[], ...lines.map(() => [])],
    box,
  );
  const observer = new ResizeObserver(() => {
    if (box.clientWidth > 0) chart.setSize({ width: box.clientWidth, height: box.clientHeight });
  });
  observer.observe(box);
  return {
    draw: (columns) => chart.setData(columns),
    dispose() {
      observer.disconnect();
      chart.destroy();
    },
  };
}

function padded(low: number | null, high: number | null, lines: readonly Line[]): [number, number] {
  // Without a value uPlot passes nulls.
  const measured: [number, number] = [low ?? -1, high ?? 1];
  const reach = LIMIT_WITHIN * Math.max(SMALLEST_RANGE, measured[1] - measured[0]);
  let [from, to] = measured;
  for (const limit of lines.flatMap(({ limits }) => limits)) {
    if (limit > measured[1] + reach || limit < measured[0] - reach) continue;
    [from, to] = [Math.min(from, limit), Math.max(to, limit)];
  }
  const pad = Math.max((SMALLEST_RANGE - (to - from)) / 2, (to - from) * 0.08);
  return [from - pad, to + pad];
}

/** Each joint's limits, dashed in its colour; shared limits once. */
function paintLimits(plot: uPlot, lines: readonly Line[]): void {
  const { ctx, bbox } = plot;
  const { min = NaN, max = NaN } = plot.scales["y"] ?? {};
  ctx.save();
  ctx.setLineDash([6, 5]);
  for (const { limits, colour: line } of lines) {
    for (const limit of limits) {
      if (!(limit >= min && limit <= max)) continue;
      const y = plot.valToPos(limit, "y", true);
      ctx.strokeStyle = line;
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
    }
  }
  ctx.restore();
}
