/** History of one measured field: the stored series, continued with live measurements. */
import type { DeviceStore } from "../devices/model";
import { newestOf } from "../health/model";
import { effect } from "@preact/signals";
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { serverNow } from "../../shared/lib/clock";
import { ApiError, sentence } from "../../shared/api/http";
import { digits, type Quantity } from "./model/quantities";
import { Recording } from "./model/stored-series";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import type { Marks, SeriesChart } from "./series-chart";
import { colour, onColourChange } from "../../shared/ui/canvas-theme";

const DRAW_EVERY_MS = 500;
const POINTS = 400;
/** The cloud stores measurements with a delay: reloading after this time closes the gap to the live data [ms]. */
const RELOAD_MS = 30_000;
const PAGE_STEP = 10;

/** Stored and live samples of a time span. `loads` increases with each response. */
export function useRecording(api: Api, device: DeviceStore, { stream, field }: Quantity, spanMs: number) {
  const recording = useMemo(() => new Recording(), [device, stream, field]);
  const [error, setError] = useState("");
  const [loads, setLoads] = useState(0);
  useEffect(
    () =>
      effect(() => {
        const newest = newestOf(device, stream, field);
        if (newest !== null) recording.add(newest.atMs, Number(newest.value));
      }),
    [recording, device, stream, field],
  );
  useEffect(() => {
    let active = true;
    const load = (): void => {
      api.series(device.id, stream, serverNow() - spanMs, POINTS, field).then(
        (series) => {
          if (!active) return;
          recording.load(series, field);
          setError("");
          setLoads((count) => count + 1);
        },
        (error: unknown) => {
          // No measurements are stored yet.
          const unknown = error instanceof ApiError && error.status === 404;
          if (active && !unknown) setError(sentence(error));
        },
      );
    };
    load();
    const timer = setInterval(load, RELOAD_MS);
    return () => {
      active = false;
      clearInterval(timer);
    };
  }, [api, device, recording, stream, field, spanMs]);
  return { recording, error, loads };
}

interface HistoryProps {
  recording: Recording;
  quantity: Quantity;
  spanMs: number;
  binary: boolean;
  old: boolean;
  /** With these, the plot can be read point by point, by keyboard or pointer. */
  marks?: Omit<Marks, "cursor">;
}

type Columns = [number[], (number | null)[], (number | null)[], (number | null)[]];

export function HistoryCard({ recording, quantity, spanMs, binary, old, marks }: HistoryProps) {
  const box = useRef<HTMLDivElement>(null);
  const [failed, setFailed] = useState(false);
  const [repaint, setRepaint] = useState(0);
  const [reading, setReading] = useState("");
  /** Cursor position [s since 1970]; `null`: none. */
  const cursor = useRef<number | null>(null);
  const drawn = useRef<{ columns: Columns; chart: SeriesChart | null; draw: () => void }>({
    columns: [[], [], [], []],
    chart: null,
    draw: () => undefined,
  });
  const shown = useRef(marks);
  shown.current = marks;
  useEffect(() => onColourChange(() => setRepaint((count) => count + 1)), []);
  useEffect(() => {
    if (box.current === null) return;
    const element = box.current;
    let active = true;
    const draw = (): void => {
      const until = Math.max(serverNow(), recording.samples(0).at(-1)?.at ?? 0);
      const [times, ...values] = recording.columns(until - spanMs);
      const inUnit = values.map((column) => column.map((one) => (one === null ? null : quantity.toDisplay(one))));
      const columns = [times, ...inUnit] as Columns;
      drawn.current.columns = columns;
      const currentMarks = shown.current;
      const extra = currentMarks === undefined ? undefined : { ...currentMarks, cursor: cursor.current };
      drawn.current.chart?.draw((until - spanMs) / 1000, until / 1000, times, inUnit, extra);
      const measured = columns[1].filter((one) => one !== null);
      element.setAttribute("data-points", String(measured.length));
      element.setAttribute("aria-label", chartLabel(quantity, measured));
      if (currentMarks !== undefined) updateSliderAttributes(element, columns, cursor.current, quantity);
    };
    drawn.current.draw = draw;
    import("./series-chart").then(
      ({ createSeriesChart }) => {
        if (!active) return;
        drawn.current.chart = createSeriesChart(element, { quantity, binary, colour: colour("--series-1") });
        draw();
      },
      () => setFailed(true),
    );
    const timer = setInterval(draw, DRAW_EVERY_MS);
    return () => {
      active = false;
      clearInterval(timer);
      drawn.current.chart?.dispose();
      drawn.current.chart = null;
    };
  }, [recording, quantity, spanMs, binary, repaint]);

  const goTo = (time: number | null): void => {
    cursor.current = time;
    drawn.current.draw();
    const { columns } = drawn.current;
    setReading(time === null ? "" : describePoint(columns, nearest(columns, time), quantity));
  };
  const onKeyDown = (event: KeyboardEvent): void => {
    const { columns } = drawn.current;
    const to = indexForKey(event.key, columns, cursor.current);
    if (to === null) return;
    event.preventDefault();
    goTo(columns[0][to] ?? null);
  };
  const point = (event: PointerEvent): void => {
    const { chart, columns } = drawn.current;
    if (chart !== null) goTo(columns[0][nearest(columns, chart.timeAt(event.clientX))] ?? null);
  };

  if (failed) return <p class="notice">{common.chartFailed}</p>;
  const kind = `chart series ${binary ? "binary" : ""} ${old ? "old" : ""}`;
  if (marks === undefined) return <div ref={box} class={kind} data-testid="series" role="img" />;
  return (
    <>
      <div
        ref={box}
        class={kind}
        data-testid="series"
        role="slider"
        aria-orientation="horizontal"
        aria-label={quantity.label}
        aria-valuenow={0}
        tabIndex={0}
        onKeyDown={onKeyDown}
        onPointerMove={point}
        onPointerLeave={() => goTo(null)}
        onBlur={() => goTo(null)}
      />
      <p class="reading-at small" data-testid="reading-at">
        {reading === "" ? <span class="quiet">{texts.trend.keys}</span> : reading}
      </p>
    </>
  );
}

/** Updates the cursor's description for screen readers. */
function updateSliderAttributes(element: HTMLElement, columns: Columns, cursor: number | null, quantity: Quantity): void {
  const at = nearest(columns, cursor ?? Infinity);
  element.setAttribute("aria-valuemin", "0");
  element.setAttribute("aria-valuemax", String(Math.max(0, columns[0].length - 1)));
  element.setAttribute("aria-valuenow", String(Math.max(0, at)));
  element.setAttribute("aria-valuetext", describePoint(columns, at, quantity));
}

/** The index of the measured point nearest to a time; -1: none. */
function nearest([times, means]: Columns, time: number): number {
  let found = -1;
  times.forEach((one, index) => {
    const distance = time === Infinity ? -one : Math.abs(one - time);
    const bestDistance = time === Infinity ? -(times[found] ?? -Infinity) : Math.abs((times[found] ?? -Infinity) - time);
    if (means[index] !== null && distance < bestDistance) found = index;
  });
  return found;
}

/** The index of the point that a key selects, or `null` for other keys. */
function indexForKey(key: string, columns: Columns, cursor: number | null): number | null {
  const by = { ArrowLeft: -1, ArrowRight: 1, PageUp: -PAGE_STEP, PageDown: PAGE_STEP, Home: -Infinity, End: Infinity }[key];
  const measured = columns[1].flatMap((mean, index) => (mean === null ? [] : [index]));
  if (by === undefined || measured.length === 0) return null;
  const position = measured.indexOf(nearest(columns, cursor ?? Infinity));
  const to = Math.min(measured.length - 1, Math.max(0, position + by));
  return measured[to] ?? null;
}

function describePoint([times, means, lows, highs]: Columns, index: number, { unit }: Quantity): string {
  const [at, mean, low, high] = [times[index], means[index], lows[index], highs[index]];
  if (at === undefined || mean === undefined || mean === null) return texts.trend.noData;
  const places = digits(Math.max(Math.abs(mean) / 100, 0.01));
  const text = (value: number): string => `${value.toFixed(places)} ${unit}`.trim();
  const band = low === high || low === null || high === null || low === undefined || high === undefined ? null : [text(low), text(high)] as const;
  return texts.trend.at(format.recentTime(at * 1000), text(mean), band);
}

function chartLabel({ label, unit }: Quantity, measured: readonly number[]): string {
  if (measured.length === 0) return texts.room.chartEmpty(label);
  let [low, high] = [Infinity, -Infinity];
  for (const one of measured) [low, high] = [Math.min(low, one), Math.max(high, one)];
  const places = digits(high - low);
  return texts.room.chart(label, low.toFixed(places), high.toFixed(places), unit);
}
