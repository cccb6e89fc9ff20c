/** Events in the visible part of the time axis. Each moves the cursor to its time. */
import { Card } from "../../../shared/ui/card";
import { groupOf, nearestEvents, type Replay } from "../model/recording";
import { texts } from "./texts";

/** More are not readable at once. */
const MOST = 100;

export function EventsCard({ replay }: { replay: Replay }) {
  const { events, omitted, unknown } = replay.events.value;
  const { from_s, to_s } = replay.window.value;
  const visible = events.filter(({ time_s }) => time_s >= from_s && time_s <= to_s).length;
  // The cursor changes in each frame, so only a long list depends on it.
  const around_s = visible > MOST ? Math.round(replay.cursor.value) : 0;
  const shown = nearestEvents(events, from_s, to_s, around_s, MOST);
  return (
    <Card title={texts.events.title} class="session-events" data-testid="session-events">
      {shown.length === 0 ? (
        <p class="quiet">{texts.events.none}</p>
      ) : (
        <ul class="event-list">
          {shown.map((event, index) => (
            <li key={index} class={event.severity} data-group={groupOf(event)}>
              <button type="button" class="plain" onClick={() => replay.seek(event.time_s)}>
                {texts.clock(event.time_s)}
              </button>
              {event.text}
            </li>
          ))}
        </ul>
      )}
      <p class="quiet small">
        {texts.events.explained}
        {visible > shown.length && ` ${texts.events.more(visible - shown.length)}`}
        {omitted > 0 && ` ${texts.events.omitted(omitted)}`}
        {unknown > 0 && ` ${texts.events.unknown(unknown)}`}
      </p>
    </Card>
  );
}
