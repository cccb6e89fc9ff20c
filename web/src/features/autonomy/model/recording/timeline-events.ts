/** The events of a session: those of loaded segments with their whole texts, and those of the overviews. */
import type { TimelineEvent } from "./overview";
import type { Segment } from "./segment";
import type { Timeline } from "./timeline";

/** What an event tells an operator who searches for it. */
export type EventGroup = "stop" | "fault" | "handover" | "command" | "other";

export interface EventList {
  /** In order of time. */
  events: readonly TimelineEvent[];
  /** Events that are not listed before their segment is loaded. */
  omitted: number;
  /** Number of segments whose events are not known before they are loaded: older agents wrote them. */
  unknown: number;
}

/** Sums, which the sessions of the cloud have. */
const HIDDEN = "activity";

export function groupOf({ kind, severity }: Pick<TimelineEvent, "kind" | "severity">): EventGroup {
  if (kind.startsWith("stop-")) return "stop";
  if (kind.startsWith("lease-")) return "handover";
  if (kind.startsWith("action-") || kind.startsWith("command-")) return "command";
  return severity === "error" || kind.endsWith("-failed") ? "fault" : "other";
}

/** `segmentOf`: a decoded segment by its number; null: it is not loaded. */
export function eventsOf({ parts }: Timeline, segmentOf: (segment: number) => Pick<Segment, "events" | "extent"> | null): EventList {
  const found: { events: TimelineEvent[]; omitted: number; unknown: number } = { events: [], omitted: 0, unknown: 0 };
  for (const { info, overview } of parts) {
    const segment = segmentOf(info.segment);
    const summary = overview === null || typeof overview === "string" ? null : overview;
    if (segment !== null && (segment.extent === "whole" || (summary?.events ?? null) === null)) found.events.push(...whole(segment));
    else {
      found.events.push(...(summary?.events ?? []));
      found.omitted += summary?.events_omitted ?? 0;
    }
    if (segment?.extent !== "whole" && summary !== null && summary.events === null) found.unknown += 1;
  }
  found.events.sort((one, other) => one.time_s - other.time_s);
  return found;
}

function whole({ events }: Pick<Segment, "events">): TimelineEvent[] {
  return events
    .filter(({ event }) => event.kind !== HIDDEN)
    .map(({ time_s, event: { kind, severity, message } }) => ({ time_s, kind, severity, text: message }));
}

/** At most `most` events of a time [s]: those that are nearest to `around_s`. */
export function nearestEvents(events: readonly TimelineEvent[], from_s: number, to_s: number, around_s: number, most: number): readonly TimelineEvent[] {
  const visible = events.filter(({ time_s }) => time_s >= from_s && time_s <= to_s);
  if (visible.length <= most) return visible;
  const distance = ({ time_s }: TimelineEvent): number => Math.abs(time_s - around_s);
  return visible.toSorted((one, other) => distance(one) - distance(other)).slice(0, most).sort((one, other) => one.time_s - other.time_s);
}
