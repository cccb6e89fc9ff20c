/** The papers' plots: response times over samples, and the cumulative distribution. */
import { Card } from "../../shared/ui/card";
import { useEffect, useRef, useState } from "preact/hooks";
import type { Published } from "./model/published-figures";
import { distribution, type Line } from "./model/latency-stats";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";
import { onColourChange, seriesColour } from "../../shared/ui/canvas-theme";
import type { XAxis, PlotSeries, Reference, LatencyChart } from "./plot-canvas";

export type Axis = keyof typeof texts.axes;
export type Scale = keyof typeof texts.scales;

interface LatencyPlotsProps {
  lines: readonly Line[];
  name: (line: Line) => string;
  published: readonly Published[];
  axis: Axis;
  scale: Scale;
}

export function LatencyPlots({ lines, name, published, axis, scale }: LatencyPlotsProps) {
  const references = published.map(({ id, ms }) => ({ label: texts.published[id] ?? id, ms }));
  const overTime = lines.map((line, index): PlotSeries => {
    const x = line.samples.map(({ atMs }, place) => (axis === "time" ? atMs / 1000 + place / 1e6 : place + 1));
    return { label: name(line), colour: seriesColour(index), x, y: line.samples.map(({ ms }) => ms) };
  });
  const distributions = lines.map((line, index): PlotSeries => {
    const [x, y] = distribution(line.samples);
    return { label: name(line), colour: seriesColour(index), x, y: y.map((one) => one * 100) };
  });
  return (
    <div class="latency-charts">
      <PlotCard title={texts.overTime} xAxis={axis} scale={scale} lines={overTime} references={references} />
      <PlotCard title={texts.shares} xAxis="ms" scale={scale} lines={distributions} references={references} />
    </div>
  );
}

interface PlotCardProps {
  title: string;
  xAxis: XAxis;
  scale: Scale;
  lines: readonly PlotSeries[];
  references: readonly Reference[];
}

function PlotCard({ title, xAxis, scale, lines, references }: PlotCardProps) {
  const box = useRef<HTMLDivElement>(null);
  const chart = useRef<LatencyChart | null>(null);
  const [failed, setFailed] = useState(false);
  const [repaint, setRepaint] = useState(0);
  const latest = useRef({ lines, references });
  latest.current = { lines, references };
  useEffect(() => onColourChange(() => setRepaint((count) => count + 1)), []);
  useEffect(() => {
    if (box.current === null) return;
    const element = box.current;
    let mounted = true;
    import("./plot-canvas").then(
      ({ createLatencyChart }) => {
        if (!mounted) return;
        chart.current = createLatencyChart(element, { xAxis, log: scale === "log" });
        chart.current.draw(latest.current.lines, latest.current.references);
      },
      () => setFailed(true),
    );
    return () => {
      mounted = false;
      chart.current?.dispose();
      chart.current = null;
    };
  }, [xAxis, scale, repaint]);
  useEffect(() => chart.current?.draw(lines, references), [lines, references]);
  const samples = lines.reduce((sum, { x }) => sum + x.length, 0);
  return (
    <Card title={title}>
      {failed && <p class="notice">{common.chartFailed}</p>}
      <div
        ref={box}
        class="latency-chart"
        data-testid={`latency-${xAxis === "ms" ? "shares" : "samples"}`}
        data-samples={samples}
        data-references={references.length}
        role="img"
        aria-label={texts.chart(title, lines.length, samples)}
      />
    </Card>
  );
}
