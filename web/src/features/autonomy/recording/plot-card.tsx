/** Measured and applied positions of the joints over the visible part of the time axis. */
import { useSignalEffect } from "@preact/signals";
import { useEffect, useRef, useState } from "preact/hooks";
import { common } from "../../../shared/i18n/common";
import { onColourChange, seriesColour } from "../../../shared/ui/canvas-theme";
import { Card } from "../../../shared/ui/card";
import type { DeviceStore } from "../../devices/model";
import type { PositionChart } from "./position-chart";
import { comparedColumns, type PlotColumns, plotColumns, type Range, type Replay, type Samples } from "../model/recording";
import type { Comparison } from "../model/recording/comparison";
import { texts } from "./texts";
import { scrubbing, timeAtX, useCursorPosition, useWheelZoom } from "./timeline-bar";

/** Joints that are drawn at first. More lines than colours cannot be distinguished. */
const FIRST = 8;
/** In a longer part, rows are closer than the pixels, and the overview is drawn [s]. */
const DETAIL_S = 120;

export function PlotCard({ device, replay, comparison }: { device: DeviceStore; replay: Replay; comparison: Comparison | null }) {
  const compared = comparison?.state.value === "ready" ? comparison : null;
  const { joints } = replay.timeline.value;
  const [chosen, setChosen] = useState<ReadonlySet<string> | null>(null);
  const [failed, setFailed] = useState(false);
  const box = useRef<HTMLDivElement>(null);
  const area = useRef<HTMLDivElement>(null);
  useCursorPosition(area, replay);
  useWheelZoom(area, replay, (event) => event.ctrlKey || event.metaKey);
  const shown = chosen ?? new Set(joints.slice(0, FIRST));
  const indices = joints.flatMap((name, index) => (shown.has(name) ? [index] : []));
  const chart = useChart(box, indices, () => setFailed(true));
  const labels = new Map(device.description.value?.joints.map(({ name, label }) => [name, label]));
  const toggle = (name: string): void => {
    const next = new Set(shown);
    if (!next.delete(name)) next.add(name);
    setChosen(next);
  };
  return (
    <Card title={texts.plot.title} class="session-plot" aside={<span class="quiet small">{compared === null ? texts.plot.legend : texts.plot.comparedLegend}</span>}>
      {failed && <p class="notice">{common.chartFailed}</p>}
      {chart !== null && <Draw key={`${chart.id} ${compared !== null}`} chart={chart} replay={replay} comparison={compared} joints={indices} />}
      <div class="session-chart">
        <div ref={box} class="chart" data-testid="session-plot" role="img" aria-label={texts.plot.label} />
        <div
          class="session-plot-area"
          ref={area}
          {...scrubbing(replay, (clientX) => timeAtX(area.current, replay, clientX))}
        >
          <span class="session-line-cursor" />
        </div>
      </div>
      <fieldset class="legend">
        <legend class="visually-hidden">{texts.plot.joints}</legend>
        {joints.map((name, index) => (
          <label key={name} class={`series-${(index % 8) + 1}`}>
            <input type="checkbox" checked={shown.has(name)} onChange={() => toggle(name)} />
            {labels.get(name) ?? name}
          </label>
        ))}
      </fieldset>
    </Card>
  );
}

/** The chart for a choice of joints; null until its code is loaded. A change of theme creates it anew. */
function useChart(box: { current: HTMLDivElement | null }, joints: readonly number[], onFailure: () => void): PositionChart | null {
  const [chart, setChart] = useState<PositionChart | null>(null);
  const [repaint, setRepaint] = useState(0);
  useEffect(() => onColourChange(() => setRepaint((count) => count + 1)), []);
  useEffect(() => {
    const element = box.current;
    if (element === null) return undefined;
    let active = true;
    let created: PositionChart | null = null;
    import("./position-chart").then(
      ({ createPositionChart }) => {
        if (!active) return;
        created = createPositionChart(element, joints.map(seriesColour));
        setChart(created);
      },
      onFailure,
    );
    return () => {
      active = false;
      created?.dispose();
      setChart(null);
    };
  }, [joints.join(), repaint]);
  return chart;
}

interface DrawProps {
  chart: PositionChart;
  replay: Replay;
  comparison: Comparison | null;
  joints: readonly number[];
}

/** Passes data and the visible part to the chart, at most once in each frame. */
function Draw({ chart, replay, comparison, joints }: DrawProps) {
  const drawn = useRef<readonly unknown[]>([]);
  useSignalEffect(() => {
    const range = replay.window.value;
    const pieces = piecesOf(replay, range);
    const others = comparison === null ? null : piecesOf(comparison.second, comparison.window.value);
    const offset_s = comparison?.offset_s.value ?? 0;
    const contents = [offset_s, pieces.length, ...pieces, ...(others ?? [])];
    const request = requestAnimationFrame(() => {
      const same = contents.length === drawn.current.length && contents.every((each, index) => each === drawn.current[index]);
      const columns = (): PlotColumns => {
        const first = plotColumns(pieces, joints);
        return others === null ? first : comparedColumns(first, plotColumns(others, joints), offset_s);
      };
      chart.draw(same ? null : columns(), range);
      drawn.current = contents;
    });
    return () => cancelAnimationFrame(request);
  });
  return null;
}

/** All overviews; in a short visible part its rows, where they are loaded. */
function piecesOf(replay: Replay, { from_s, to_s }: Range): Samples[] {
  const detailed = to_s - from_s <= DETAIL_S;
  return replay.timeline.value.parts.flatMap(({ info, overview, start_s, end_s }) => {
    const segment = detailed && start_s <= to_s && end_s >= from_s ? replay.segments.get(info.segment) : null;
    const found = segment?.extent === "whole" ? segment : overview;
    return found === null || typeof found === "string" ? [] : [found];
  });
}
