/** Playing, zooming and searching a recording. */
import { Card } from "../../../shared/ui/card";
import { type EventGroup, type Replay, SOURCES, SPEEDS } from "../model/recording";
import type { Comparison } from "../model/recording/comparison";
import { ComparedBar } from "./comparison/compared-bar";
import { texts } from "./texts";
import { TimelineBar } from "./timeline-bar";

/** Length of the visible part after one press, relative to the previous one. */
const ZOOM = 0.5;
const PAN = 0.5;

export function TimelineCard({ replay, editable, comparison }: { replay: Replay; editable: boolean; comparison: Comparison | null }) {
  const playing = replay.playing.value;
  const { from_s, to_s } = replay.window.value;
  const duration = replay.timeline.value.duration_s;
  const whole = to_s - from_s >= duration;
  return (
    <Card title={texts.time.title} class="session-timeline">
      <div class="row">
        <button type="button" class="primary" data-testid="session-play" aria-pressed={playing} onClick={() => (playing ? replay.pause() : replay.play())}>
          {playing ? texts.time.pause : texts.time.play}
        </button>
        <label class="row">
          {texts.time.speed}
          <select data-testid="session-speed" value={String(replay.speed.value)} onChange={(event) => replay.setSpeed(Number(event.currentTarget.value))}>
            {SPEEDS.map((speed) => (
              <option key={speed} value={String(speed)}>
                {texts.time.speedOf(speed)}
              </option>
            ))}
          </select>
        </label>
        <Clock replay={replay} />
        <span class="row session-zoom">
          <button type="button" class="plain" disabled={from_s <= 0} onClick={() => replay.pan(-PAN)}>
            {texts.time.earlier}
          </button>
          <button type="button" class="plain" disabled={to_s >= duration} onClick={() => replay.pan(PAN)}>
            {texts.time.later}
          </button>
          <button type="button" class="plain" data-testid="zoom-in" onClick={() => replay.zoom(ZOOM, replay.cursor.peek())}>
            {texts.time.zoomIn}
          </button>
          <button type="button" class="plain" disabled={whole} onClick={() => replay.zoom(1 / ZOOM, replay.cursor.peek())}>
            {texts.time.zoomOut}
          </button>
          <button type="button" class="plain" data-testid="zoom-all" disabled={whole} onClick={() => replay.showAll()}>
            {texts.time.all}
          </button>
        </span>
      </div>
      <TimelineBar replay={replay} editable={editable} />
      {comparison !== null && <ComparedBar comparison={comparison} />}
      <p class="legend session-legend small" aria-label={texts.time.legend}>
        {SOURCES.map((source) => (
          <span key={source}>
            <span class={`session-key session-${source}`} aria-hidden="true" /> {texts.source[source]}
          </span>
        ))}
        <span>
          <span class="session-key session-none" aria-hidden="true" /> {texts.time.gap}
        </span>
        {(Object.entries(texts.events.group) as [EventGroup, string][]).map(([group, name]) => (
          <span key={group}>
            <span class={`session-mark mark-${group}`} aria-hidden="true" /> {name}
          </span>
        ))}
      </p>
      <p class="quiet small">{texts.time.help}</p>
    </Card>
  );
}

function Clock({ replay }: { replay: Replay }) {
  return (
    <output class="session-clock" data-testid="session-clock" data-at={replay.cursor.value}>
      {texts.time.at(replay.cursor.value, replay.timeline.value.duration_s)}
    </output>
  );
}
