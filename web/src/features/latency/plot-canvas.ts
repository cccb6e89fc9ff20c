/** Response-time plots as in the papers, and their distribution. Loaded on demand. */
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { colour } from "../../shared/ui/canvas-theme";

/** One line: x and y values. */
export interface PlotSeries {
  label: string;
  colour: string;
  x: number[];
  y: number[];
}

export interface Reference {
  label: string;
  ms: number;
}

export interface LatencyChart {
  draw(lines: readonly PlotSeries[], references: readonly Reference[]): void;
  dispose(): void;
}

/** The x axis: sample number, time [s since 1970] or duration [ms]. */
export type XAxis = "order" | "time" | "ms";

interface Options {
  xAxis: XAxis;
  /** Whether durations use a logarithmic axis. */
  log: boolean;
}

/** uPlot's value for a logarithmic scale: its `const enum` cannot be used with `isolatedModules`. */
// eslint-disable-next-line @typescript-eslint/no-unsafe-enum-assignment
const LOG: uPlot.Scale.Distr = 3;
const LABEL_PX = 11;

export function createLatencyChart(box: HTMLElement, { xAxis, log }: Options): LatencyChart {
  let references: readonly Reference[] = [];
  let plot: uPlot | null = null;
  let drawn = "";
  const range = (low: number | null, high: number | null): [number, number] => {
    const all = [low, high, ...references.map(({ ms }) => ms)].filter((one) => one !== null && one > 0) as number[];
    if (all.length === 0) return [1, 1000];
    const [least, most] = [Math.min(...all), Math.max(...all)];
    return log ? [least / 1.4, most * 1.6] : [0, most * 1.1];
  };
  const build = (lines: readonly PlotSeries[]): uPlot => {
    const axis = { stroke: colour("--quiet"), grid: { stroke: colour("--line"), width: 1 }, ticks: { stroke: colour("--line"), width: 1 } };
    // The end of a logarithmic axis is not a round number.
    const inMs = (ticks: (number | null)[]): string[] =>
      ticks.map((tick) => (tick === null ? "" : `${Number(tick.toPrecision(3))} ${texts.milliseconds}`));
    const times = { ...(log ? { distr: LOG, log: 10 as const } : {}), range: (_: uPlot, low: number | null, high: number | null) => range(low, high) };
    const stepped = uPlot.paths.stepped?.({ align: 1 });
    return new uPlot(
      {
        width: Math.max(1, box.clientWidth),
        height: Math.max(1, box.clientHeight),
        legend: { show: false },
        cursor: { show: false },
        scales: {
          x: xAxis === "ms" ? { time: false, ...times } : { time: false },
          y: xAxis === "ms" ? { range: [0, 100] } : times,
        },
        axes: [
          { ...axis, space: 60, values: (_, ticks) => (xAxis === "ms" ? inMs(ticks) : ticks.map((tick) => (xAxis === "time" ? format.recentTime(tick * 1000).slice(0, 14) : whole(tick)))) },
          { ...axis, size: 70, values: (_, ticks) => (xAxis === "ms" ? ticks.map((tick) => `${tick} ${texts.percent}`) : inMs(ticks)) },
        ],
        series: [
          {},
          ...lines.map((line) => ({
            label: line.label,
            stroke: line.colour,
            width: 1.75,
            spanGaps: true,
            points: { show: xAxis !== "ms", size: 5, fill: line.colour },
            ...(xAxis === "ms" && stepped !== undefined ? { paths: stepped } : {}),
          })),
        ],
        hooks: { draw: [(chart) => paint(chart, references, xAxis)] },
      },
      aligned(lines),
      box,
    );
  };
  const observer = new ResizeObserver(() => {
    if (box.clientWidth > 0) plot?.setSize({ width: box.clientWidth, height: box.clientHeight });
  });
  observer.observe(box);
  return {
    draw(lines, newReferences) {
      references = newReferences;
      // uPlot accepts new values for the same lines; other lines need a new plot.
      const names = lines.map((line) => `${line.label} ${line.colour}`).join("\n");
      if (plot !== null && names === drawn) {
        plot.setData(aligned(lines));
        return;
      }
      plot?.destroy();
      plot = build(lines);
      drawn = names;
    },
    dispose() {
      observer.disconnect();
      plot?.destroy();
    },
  };
}

function aligned(lines: readonly PlotSeries[]): uPlot.AlignedData {
  if (lines.length === 0) return [[]];
  return uPlot.join(lines.map(({ x, y }) => [x, y] as uPlot.AlignedData));
}

function whole(tick: number): string {
  return Number.isInteger(tick) ? String(tick) : "";
}

/** Published figures as dashed lines, labelled where there is space. */
function paint(plot: uPlot, references: readonly Reference[], xAxis: XAxis): void {
  const { ctx, bbox } = plot;
  const ratio = devicePixelRatio;
  const vertical = xAxis === "ms";
  ctx.save();
  ctx.strokeStyle = colour("--marker");
  ctx.lineWidth = ratio;
  ctx.font = `${LABEL_PX * ratio}px system-ui, sans-serif`;
  ctx.textAlign = "left";
  ctx.textBaseline = "alphabetic";
  ctx.setLineDash([6 * ratio, 4 * ratio]);
  let last = Infinity;
  for (const { label, ms } of [...references].sort((one, other) => other.ms - one.ms)) {
    const at = plot.valToPos(ms, vertical ? "x" : "y", true);
    ctx.beginPath();
    if (vertical) {
      ctx.moveTo(at, bbox.top);
      ctx.lineTo(at, bbox.top + bbox.height);
    } else {
      ctx.moveTo(bbox.left, at);
      ctx.lineTo(bbox.left + bbox.width, at);
    }
    ctx.stroke();
    // The list next to the chart contains all names; skip labels that would overlap.
    if (vertical || Math.abs(at - last) < LABEL_PX * 1.2 * ratio) continue;
    const text = `${label}: ${ms} ${texts.milliseconds}`;
    ctx.fillStyle = colour("--surface");
    ctx.fillRect(bbox.left + 2 * ratio, at - (LABEL_PX + 3) * ratio, ctx.measureText(text).width + 4 * ratio, (LABEL_PX + 2) * ratio);
    ctx.fillStyle = colour("--marker");
    ctx.fillText(text, bbox.left + 4 * ratio, at - 3 * ratio, bbox.width - 8 * ratio);
    last = at;
  }
  ctx.restore();
}
