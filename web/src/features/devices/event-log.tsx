import { Card } from "../../shared/ui/card";
import { clock, toPageClock } from "../../shared/lib/clock";
import type { DeviceStore } from "./model/device-store";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

/** Active faults and past events, newest first. */
export function EventLog({ device }: { device: DeviceStore }) {
  const events = device.events.value;
  const faults = device.state.value?.faults ?? [];
  const age = (atMs: number): string => format.age(Math.max(0, clock.value - toPageClock(atMs)));
  return (
    <Card title={texts.cards.events} class="events">
      {faults.length > 0 && (
        <ul class="faults" aria-label={texts.events.faults}>
          {faults.map((fault) => (
            <li key={fault.code} class="notice bad">
              <strong>{fault.code}</strong> {fault.message} <span class="quiet">{age(fault.since_ms)}</span>
            </li>
          ))}
        </ul>
      )}
      {events.length === 0 && faults.length === 0 && <p class="quiet">{texts.events.none}</p>}
      <ul class="event-list" tabIndex={0} aria-label={texts.cards.events}>
        {events.map((event) => (
          <li key={event.id} class={event.severity}>
            {event.message} <span class="quiet">{age(event.at_ms)}</span>
          </li>
        ))}
      </ul>
    </Card>
  );
}
