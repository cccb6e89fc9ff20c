/** A line chart of the last seconds. Loaded only where one is looked at. */
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { SPAN_MS } from "../core/history";
import { texts } from "../texts";
import { colour } from "./theme";

export interface Line {
  label: string;
  colour: string;
}

export interface Chart {
  draw(columns: [number[], ...(number | null)[][]]): void;
  dispose(): void;
}

/** Ranges smaller than this are noise, and are drawn as what they are: a line. */
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
        y: { range: (_, low, high) => padded(low, high) },
      },
      axes: [
        { ...axis, values: (_, ticks) => ticks.map((tick) => `${tick} ${texts.plot.seconds}`) },
        { ...axis, size: 62, values: (_, ticks) => ticks.map((tick) => `${tick} ${unit}`) },
      ],
      series: [
        {},
        ...lines.map((line) => ({ label: line.label, stroke: line.colour, width: 1.75, points: { show: false } })),
      ],
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

function padded(low: number | null, high: number | null): [number, number] {
  // Without a value there is nothing to fit; uPlot passes nulls then.
  const from = low ?? -1;
  const to = high ?? 1;
  const pad = Math.max((SMALLEST_RANGE - (to - from)) / 2, (to - from) * 0.08);
  return [from - pad, to + pad];
}
