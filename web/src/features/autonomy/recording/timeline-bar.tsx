/** The time axis: what caused the motion, events, episodes with their ends, and the cursor. */
import { type ReadonlySignal, useSignalEffect } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import type { HTMLAttributes, RefObject } from "preact";
import { type EpisodeList, type Range, type Replay, trimmed } from "../model/recording";
import { paintTimeline } from "./timeline-canvas";
import { texts } from "./texts";
import { canvasBox } from "../../../shared/ui/hidpi-canvas";
import { onColourChange } from "../../../shared/ui/canvas-theme";

const MINUTE_S = 60;
/** Zoom for one step of a wheel. */
const WHEEL_ZOOM = 0.0015;
/** A wheel that counts lines moves about this many pixels for each [px]. */
const LINE_PX = 16;

export function TimelineBar({ replay, editable }: { replay: Replay; editable: boolean }) {
  const box = useRef<HTMLDivElement>(null);
  const canvas = useRef<HTMLCanvasElement>(null);
  useCursorPosition(box, replay);
  useWheelZoom(box, replay, () => true);
  usePainting(canvas, replay, replay.window);
  const timeAt = (clientX: number): number => timeAtX(box.current, replay, clientX);
  return (
    <div class="session-axis" ref={box}>
      <div
        class="session-bar"
        data-testid="session-bar"
        {...scrubbing(replay, timeAt)}
      >
        <canvas ref={canvas} aria-hidden="true" />
        <Cursor replay={replay} />
      </div>
      <EpisodeStrip replay={replay} editable={editable} timeAt={timeAt} />
    </div>
  );
}

/** Handlers of an element whose pointer moves the cursor. `timeAt`: the time at a page coordinate [s]. */
export function scrubbing(replay: Replay, timeAt: (clientX: number) => number): Pick<HTMLAttributes<HTMLElement>, "onPointerDown" | "onPointerMove" | "onLostPointerCapture"> {
  return {
    onPointerDown(event) {
      event.currentTarget.setPointerCapture(event.pointerId);
      replay.drag(true);
      replay.seek(timeAt(event.clientX));
    },
    onPointerMove(event) {
      if (event.currentTarget.hasPointerCapture(event.pointerId)) replay.seek(timeAt(event.clientX));
    },
    onLostPointerCapture: () => replay.drag(false),
  };
}

/** The time at a page coordinate [s]. */
export function timeAtX(box: HTMLElement | null, replay: Replay, clientX: number): number {
  const { from_s, to_s } = replay.window.peek();
  const area = box?.getBoundingClientRect();
  return area === undefined ? from_s : from_s + ((clientX - area.left) / area.width) * (to_s - from_s);
}

/** Writes the place of the cursor in the visible part to the CSS variable `--at`, without a new rendering. */
export function useCursorPosition(box: RefObject<HTMLElement | null>, replay: Replay): void {
  useSignalEffect(() => {
    const { from_s, to_s } = replay.window.value;
    const at = (replay.cursor.value - from_s) / (to_s - from_s);
    box.current?.style.setProperty("--at", String(at));
    box.current?.classList.toggle("cursor-outside", at < 0 || at > 1);
  });
}

/** Zooms with the wheel around the pointer. `when`: whether an event zooms instead of scrolling the page. */
export function useWheelZoom(box: RefObject<HTMLElement | null>, replay: Replay, when: (event: WheelEvent) => boolean): void {
  useEffect(() => {
    const element = box.current;
    if (element === null) return undefined;
    const zoom = (event: WheelEvent): void => {
      if (!when(event)) return;
      event.preventDefault();
      const px = event.deltaMode === WheelEvent.DOM_DELTA_PIXEL ? 1 : LINE_PX;
      if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)) replay.pan(((event.deltaX + event.deltaY) * px) / element.clientWidth);
      else replay.zoom(Math.exp(event.deltaY * px * WHEEL_ZOOM), timeAtX(element, replay, event.clientX));
    };
    // Only a listener that is not passive can prevent scrolling.
    element.addEventListener("wheel", zoom, { passive: false });
    return () => element.removeEventListener("wheel", zoom);
  }, [replay]);
}

/** Paints the time axis of a session on a canvas. `window`: its visible part. */
export function usePainting(canvas: RefObject<HTMLCanvasElement | null>, replay: Replay, window: ReadonlySignal<Range>): void {
  useSignalEffect(() => {
    const timeline = replay.timeline.value;
    const range = window.value;
    const { events } = replay.events.value;
    const element = canvas.current;
    if (element === null) return undefined;
    let endPainting = (): void => undefined;
    const paint = (): void => {
      endPainting();
      endPainting = canvasBox(element, (context, width, height) => paintTimeline(context, width, height, { timeline, range, events }));
    };
    // Several changes in one frame are painted once.
    const request = requestAnimationFrame(paint);
    const unsubscribe = onColourChange(paint);
    return () => {
      cancelAnimationFrame(request);
      unsubscribe();
      endPainting();
    };
  });
}

function Cursor({ replay }: { replay: Replay }) {
  const at = replay.cursor.value;
  const duration = replay.timeline.value.duration_s;
  return (
    <div
      class="session-cursor"
      role="slider"
      tabIndex={0}
      aria-label={texts.time.cursor}
      aria-valuemin={0}
      aria-valuemax={duration}
      aria-valuenow={at}
      aria-valuetext={texts.time.at(at, duration)}
      data-testid="session-cursor"
      onKeyDown={(event) => {
        const to = keyTime(event, replay);
        if (to === null && event.key !== " ") return;
        event.preventDefault();
        if (to !== null) replay.seek(to);
        else if (replay.playing.peek()) replay.pause();
        else replay.play();
      }}
    />
  );
}

/** The time to which a key moves the cursor [s]; null for other keys. */
function keyTime(event: KeyboardEvent, replay: Replay): number | null {
  const at = replay.cursor.peek();
  const moment = replay.moment.peek();
  const row_s = moment.kind === "none" ? 1 : moment.samples.period_s;
  const step = event.shiftKey ? 10 : event.altKey ? row_s : 1;
  switch (event.key) {
    case "ArrowRight":
    case "ArrowUp":
      return at + step;
    case "ArrowLeft":
    case "ArrowDown":
      return at - step;
    case "PageUp":
      return at + MINUTE_S;
    case "PageDown":
      return at - MINUTE_S;
    case "Home":
      return 0;
    case "End":
      return replay.timeline.peek().duration_s;
    default:
      return null;
  }
}

interface StripProps {
  replay: Replay;
  editable: boolean;
  timeAt: (clientX: number) => number;
}

function EpisodeStrip({ replay, editable, timeAt }: StripProps) {
  const { from_s, to_s } = replay.window.value;
  const episodes = replay.episodes.list.value;
  const place = (time: number): string => String((time - from_s) / (to_s - from_s));
  return (
    <div class="session-strip" data-testid="episode-strip">
      {episodes.map(({ start_s, end_s, outcome, label }, index) => (
        <div
          key={index}
          class={`session-episode outcome-${outcome ?? "none"}`}
          style={{ "--from": place(start_s), "--to": place(end_s) }}
          title={`${texts.episodes.name(index + 1, label)}: ${texts.episodes.outcome[outcome ?? "none"]}`}
          onClick={() => replay.seek(start_s)}
        >
          <span aria-hidden="true">{texts.episodes.name(index + 1, label)}</span>
        </div>
      ))}
      {editable &&
        episodes.flatMap((episode, index) =>
          (["start_s", "end_s"] as const).map((end) => (
            <Handle key={`${index} ${end}`} replay={replay} index={index} end={end} time={episode[end]} place={place(episode[end])} timeAt={timeAt} />
          )),
        )}
    </div>
  );
}

interface HandleProps {
  replay: Replay;
  index: number;
  end: "start_s" | "end_s";
  time: number;
  place: string;
  timeAt: (clientX: number) => number;
}

/** One end of an episode, moved by dragging or arrow keys. */
function Handle({ replay, index, end, time, place, timeAt }: HandleProps) {
  const { episodes } = replay;
  const duration = replay.timeline.value.duration_s;
  const moved = (to: number): EpisodeList => trimmed(episodes.list.peek(), index, end, to, duration);
  return (
    <div
      class={`session-handle ${end === "start_s" ? "start" : "end"}`}
      style={{ "--from": place }}
      role="slider"
      tabIndex={0}
      aria-label={end === "start_s" ? texts.episodes.startOf(index + 1) : texts.episodes.endOf(index + 1)}
      aria-valuemin={0}
      aria-valuemax={duration}
      aria-valuenow={time}
      aria-valuetext={texts.clock(time)}
      data-testid={`episode-${index + 1}-${end === "start_s" ? "start" : "end"}`}
      onPointerDown={(event) => {
        event.stopPropagation();
        event.currentTarget.setPointerCapture(event.pointerId);
      }}
      onPointerMove={(event) => {
        if (!event.currentTarget.hasPointerCapture(event.pointerId)) return;
        episodes.preview(moved(timeAt(event.clientX)));
        replay.seek(episodes.list.peek()[index]?.[end] ?? time);
      }}
      onPointerUp={() => void episodes.commit()}
      onKeyDown={(event) => {
        const step = event.shiftKey ? 1 : 0.1;
        const by = event.key === "ArrowRight" || event.key === "ArrowUp" ? step : event.key === "ArrowLeft" || event.key === "ArrowDown" ? -step : 0;
        if (by === 0) return;
        event.preventDefault();
        void episodes.commit(moved(time + by));
      }}
    />
  );
}
