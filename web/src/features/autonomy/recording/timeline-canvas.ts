/** Paints the time axis: one colour and height for each source, a pattern where no data is, events and times. */
import { colour } from "../../../shared/ui/canvas-theme";
import { type EventGroup, groupOf, type Range, type Source, type Timeline, type TimelineEvent } from "../model/recording";
import { texts } from "./texts";

interface Contents {
  timeline: Timeline;
  range: Range;
  events: readonly TimelineEvent[];
}

/** Height of a source relative to the bar, so that colour is not the only difference. */
const HEIGHTS: Record<Source, number> = { operator: 0.8, movement: 0.6, hold: 0.25, stop: 1 };
const COLOURS: Record<Source, string> = { operator: "--series-2", movement: "--series-1", hold: "--series-7", stop: "--stop" };
const EVENT_COLOURS: Record<EventGroup, string> = { stop: "--stop", fault: "--bad", handover: "--text", command: "--accent", other: "--warn" };
/** Size of an event's mark [px]. */
const MARK_PX = 5;
/** Outlines from the upper edge of the bar, in sizes of a mark. */
const MARKS: Record<EventGroup, readonly (readonly [number, number])[]> = {
  stop: [[-1.2, 0.2], [1.2, 0.2], [1.2, 2.6], [-1.2, 2.6]],
  fault: [[-1.2, 0], [1.2, 0], [0, 2.6]],
  handover: [[0, 0], [1.2, 1.3], [0, 2.6], [-1.2, 1.3]],
  command: [[-0.4, 0], [0.4, 0], [0.4, 3], [-0.4, 3]],
  other: [[-0.8, 0], [0.8, 0], [0, 1.6]],
};
/** Distances of times on an axis [s]. */
export const TIME_STEPS_S = [0.2, 0.5, 1, 2, 5, 10, 30, 60, 120, 300, 600, 1800, 3600];
/** Height of the times below the bar, and least distance of two times [px]. */
const LABELS_PX = 18;
const LABEL_EVERY_PX = 76;
const STRIPE_PX = 8;

export function paintTimeline(context: CanvasRenderingContext2D, width: number, height: number, { timeline, range, events }: Contents): void {
  const bar = height - LABELS_PX;
  const x = (time: number): number => ((time - range.from_s) / (range.to_s - range.from_s)) * width;
  paintStripes(context, width, bar);
  const ground = colour("--sunken");
  const colours = Object.fromEntries(Object.entries(COLOURS).map(([source, name]) => [source, colour(name)])) as Record<Source, string>;
  for (const { start_s, end_s, source } of timeline.spans) {
    const [from, to] = [x(start_s), x(end_s)];
    if (to < 0 || from > width) continue;
    const wide = Math.max(1, to - from);
    context.fillStyle = ground;
    context.fillRect(from, 0, wide, bar);
    context.fillStyle = colours[source];
    context.fillRect(from, bar * (1 - HEIGHTS[source]), wide, bar * HEIGHTS[source]);
  }
  paintEvents(context, width, x, events);
  paintTimes(context, width, bar, range, x);
}

/** A mark for each event; the shape states its group, so that colour is not the only difference. Stops and faults are on top. */
function paintEvents(context: CanvasRenderingContext2D, width: number, x: (time: number) => number, events: readonly TimelineEvent[]): void {
  for (const group of ["other", "command", "handover", "fault", "stop"] as const) {
    context.fillStyle = colour(EVENT_COLOURS[group]);
    context.strokeStyle = colour("--surface");
    for (const event of events) {
      const at = x(event.time_s);
      if (groupOf(event) !== group || at < 0 || at > width) continue;
      context.beginPath();
      for (const [right, down] of MARKS[group]) context.lineTo(at + right * MARK_PX, down * MARK_PX);
      context.closePath();
      context.fill();
      context.stroke();
    }
  }
}

/** The pattern of times without data. */
function paintStripes(context: CanvasRenderingContext2D, width: number, bar: number): void {
  context.save();
  context.beginPath();
  context.rect(0, 0, width, bar);
  context.clip();
  context.strokeStyle = colour("--line-strong");
  context.lineWidth = 1;
  context.beginPath();
  for (let start = -bar; start < width; start += STRIPE_PX) {
    context.moveTo(start, bar);
    context.lineTo(start + bar, 0);
  }
  context.stroke();
  context.restore();
}

function paintTimes(context: CanvasRenderingContext2D, width: number, bar: number, { from_s, to_s }: Range, x: (time: number) => number): void {
  const every = TIME_STEPS_S.find((step) => (step / (to_s - from_s)) * width >= LABEL_EVERY_PX) ?? 3600;
  context.fillStyle = colour("--quiet");
  context.font = "12px system-ui, sans-serif";
  context.textBaseline = "bottom";
  for (let time = Math.ceil(from_s / every) * every; time <= to_s; time += every) {
    const label = texts.clock(time, every < 1 ? 1 : 0);
    const wide = context.measureText(label).width;
    context.fillRect(x(time), bar, 1, 4);
    context.fillText(label, Math.min(Math.max(0, x(time) - wide / 2), width - wide), bar + LABELS_PX);
  }
}
