/** Who controlled which robot when, with Stops, faults and changes of control. */
import type { Api } from "../../../shared/api/client";
import type { StoredSession } from "../../../shared/api/autonomy";
import type { StoredEvent } from "../../../shared/api/health";
import { type Page, sentence } from "../../../shared/api/http";

const HOUR_MS = 3_600_000;
const PAGE = 100;
/** Pages of sessions, and of events, that one row reads. */
const MAX_PAGES = 10;

/** Length of the shown time and distance of the marks on its axis [ms]. */
export const TIME_RANGES = {
  hour: { lengthMs: HOUR_MS, tickMs: HOUR_MS / 6 },
  shift: { lengthMs: 12 * HOUR_MS, tickMs: 2 * HOUR_MS },
  day: { lengthMs: 24 * HOUR_MS, tickMs: 4 * HOUR_MS },
  week: { lengthMs: 168 * HOUR_MS, tickMs: 24 * HOUR_MS },
} as const;
export type TimeRange = keyof typeof TIME_RANGES;

/** Control by one person or action. */
export interface Interval {
  epoch: number;
  fromMs: number;
  /** The end; of a session that lasts, the present time. */
  toMs: number;
  lasts: boolean;
  by: "person" | "action";
  holder: string | null;
  task: string | null;
}

export type MarkKind = "stop" | "fault" | "handover";

export interface Mark {
  atMs: number;
  kind: MarkKind;
  message: string;
}

/** One robot. */
export interface Row {
  device: string;
  /** In order of time. */
  intervals: readonly Interval[];
  /** In order of time. */
  marks: readonly Mark[];
  /** Whether all sessions and events of the shown time were read; else the oldest are missing. */
  complete: boolean;
  /** Why the row could not be read, or "". */
  error: string;
}

const KINDS: Readonly<Record<string, MarkKind>> = {
  "stop-ordered": "stop",
  "stop-latched": "stop",
  "fault-raised": "fault",
  "driver-failed": "fault",
  "part-failed": "fault",
  "control-handed-over": "handover",
  "control-taken-over": "handover",
};

/** A Stop of the server and its effect at the robot are one Stop if they are not further apart [ms]. */
const SAME_STOP_MS = 5_000;

/** Reads one row. It never fails: an error is part of the row. */
export async function readRow(api: Api, device: string, fromMs: number, toMs: number, nowMs: number): Promise<Row> {
  try {
    const [sessions, events] = await Promise.all([
      readSince((cursor) => api.autonomy.sessions(device, cursor, PAGE), (session) => startOf(session) >= fromMs),
      readSince((cursor) => api.health.events(device, cursor, PAGE), (event) => Date.parse(event.at) >= fromMs),
    ]);
    return {
      device,
      intervals: intervalsOf(sessions.items, fromMs, toMs, nowMs),
      marks: marksOf(events.items, fromMs, toMs),
      complete: sessions.complete && events.complete,
      error: "",
    };
  } catch (error) {
    return { device, intervals: [], marks: [], complete: true, error: sentence(error) };
  }
}

/** Sessions between two times, oldest first. A session without a known start is left out. */
export function intervalsOf(sessions: readonly StoredSession[], fromMs: number, toMs: number, nowMs: number): Interval[] {
  return sessions
    .map(({ epoch, holder, action, task, started_at: start, ended_at: end }): Interval => {
      const lasts = end === null;
      const by = action === null ? "person" : "action";
      return { epoch, fromMs: start === null ? NaN : Date.parse(start), toMs: end === null ? nowMs : Date.parse(end), lasts, by, holder, task };
    })
    .filter((each) => each.fromMs < toMs && each.toMs >= fromMs)
    .sort((one, other) => one.fromMs - other.fromMs);
}

/** Stops, faults and changes of control between two times, oldest first. */
export function marksOf(events: readonly StoredEvent[], fromMs: number, toMs: number): Mark[] {
  const orderedMs = events.filter(({ kind }) => kind === "stop-ordered").map(({ at }) => Date.parse(at));
  // The server names the person; the robot latches a Stop before it has verified who ordered it.
  const repeats = ({ kind, at }: StoredEvent): boolean => kind === "stop-latched" && orderedMs.some((ms) => Math.abs(ms - Date.parse(at)) <= SAME_STOP_MS);
  return events
    .filter((event) => !repeats(event))
    .flatMap(({ kind, at, message }): Mark[] => {
      const mark = Object.hasOwn(KINDS, kind) ? KINDS[kind] : undefined;
      return mark === undefined ? [] : [{ atMs: Date.parse(at), kind: mark, message }];
    })
    .filter(({ atMs }) => atMs >= fromMs && atMs < toMs)
    .sort((one, other) => one.atMs - other.atMs);
}

/** Times of the marks on the axis: round times of the local time zone between `fromMs` and `toMs` [ms since 1970]. */
export function ticksOf(fromMs: number, toMs: number, tickMs: number): number[] {
  const ticks: number[] = [];
  const day = new Date(fromMs);
  day.setHours(0, 0, 0, 0);
  while (day.getTime() < toMs) {
    const startMs = day.getTime();
    day.setDate(day.getDate() + 1);
    // Days differ in length when clocks change, so each day has its own marks.
    for (let atMs = startMs; atMs < Math.min(toMs, day.getTime()); atMs += tickMs) if (atMs >= fromMs) ticks.push(atMs);
  }
  return ticks;
}

function startOf({ started_at: start }: StoredSession): number {
  return start === null ? Infinity : Date.parse(start);
}

/** Reads pages, newest first, until an item is not new enough. */
async function readSince<T>(read: (cursor: string | null) => Promise<Page<T>>, isNew: (item: T) => boolean): Promise<{ items: T[]; complete: boolean }> {
  const items: T[] = [];
  let cursor: string | null = null;
  for (let page = 0; page < MAX_PAGES; page += 1) {
    const found: Page<T> = await read(cursor);
    items.push(...found.items);
    cursor = found.cursor;
    const last = found.items.at(-1);
    if (cursor === null || (last !== undefined && !isNew(last))) return { items, complete: true };
  }
  return { items, complete: false };
}
