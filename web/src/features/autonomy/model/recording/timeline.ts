/** The time axis of a session: which parts are stored, and what caused the motion. */
import type { MissingSegment, RecordedSession, StoredSegment } from "../../../../shared/api/recordings";
import { serverNow } from "../../../../shared/lib/clock";
import { OVERVIEW_S, type Overview, type TimelineEvent } from "./overview";
import { gapOf, type Samples, SOURCES, type Source } from "./samples";

/** Overview of a segment; null: not loaded yet; a text: why it could not be loaded. */
export type LoadedOverview = Overview | string | null;

export interface Part {
  info: StoredSegment;
  /** Since the start of the session [s]. */
  start_s: number;
  end_s: number;
  overview: LoadedOverview;
}

/** A time in which one source caused the motion. */
export interface Span {
  start_s: number;
  end_s: number;
  source: Source;
}

export interface Timeline {
  parts: readonly Part[];
  joints: readonly string[];
  duration_s: number;
  spans: readonly Span[];
}

/** `unrecorded`: the agent reported that it could not record. `empty`: the recording has no rows there. */
export type GapCause = MissingSegment["cause"] | "unrecorded" | "empty";

/** A time without data, and why. */
export interface Gap {
  start_s: number;
  end_s: number;
  cause: GapCause;
}

/** Shorter times without data are not listed [s]. */
const SHORTEST_GAP_S = 1;
/** An agent that records again reports it within this time after the gap [s]. */
const RESUMED_S = 5;
/** A recording may end this long before its session: until the robot rests [s]. */
const END_S = 10;

export const EMPTY: Timeline = { parts: [], joints: [], duration_s: 0, spans: [] };

/** The time axis of a session with the overviews that are loaded, by the number of the segment. */
export function timelineOf(session: RecordedSession, overviews: ReadonlyMap<number, LoadedOverview>): Timeline {
  const segments = (session.recording?.segments ?? []).toSorted((one, other) => one.segment - other.segment);
  const first = segments[0];
  if (first === undefined) return EMPTY;
  const startMs = Date.parse(session.started_at ?? first.started_at);
  const joints = [...overviews.values()].find((one) => one !== null && typeof one !== "string")?.joints ?? [];
  const parts = segments.map((info): Part => {
    const found = overviews.get(info.segment) ?? null;
    const other = found !== null && typeof found !== "string" && found.joints.join() !== joints.join();
    const overview = other ? "The segment has other joints than the first one." : found;
    const seconds = (at: string): number => Math.max(0, (Date.parse(at) - startMs) / 1000);
    const [start, end] = typeof overview === "string" ? [] : [overview?.time_s[0], overview?.time_s.at(-1)];
    return { info, overview, start_s: start ?? seconds(info.started_at), end_s: end === undefined ? seconds(info.ended_at) : end + OVERVIEW_S };
  });
  return {
    parts,
    joints,
    duration_s: Math.max(...parts.map(({ end_s }) => end_s)),
    spans: parts.flatMap(({ overview }) => (overview === null || typeof overview === "string" ? [] : spansOf(overview))),
  };
}

/** Times without data, in order, with the end of the session. `events`: of the whole session. Parts that are not loaded have none. */
export function gapsOf(session: RecordedSession, { parts, duration_s }: Timeline, events: readonly TimelineEvent[]): readonly Gap[] {
  const missing = session.recording?.missing ?? [];
  const gaps: Gap[] = [];
  const add = (start_s: number, end_s: number, from: number, to: number, shortest_s = SHORTEST_GAP_S): void => {
    if (end_s - start_s < shortest_s) return;
    const absent = missing.find(({ segment }) => segment > from && segment < to);
    const resumed = events.some(({ kind, time_s }) => kind === "recording-resumed" && time_s >= start_s && time_s <= end_s + RESUMED_S);
    gaps.push({ start_s, end_s, cause: absent?.cause ?? (resumed ? "unrecorded" : "empty") });
  };
  let [end_s, number] = [0, -1];
  for (const { info, overview, ...part } of parts) {
    const times = overview === null || typeof overview === "string" ? null : overview.time_s;
    add(end_s, part.start_s, number, info.segment);
    times?.forEach((time, index) => add((times[index - 1] ?? time) + OVERVIEW_S, time, info.segment, info.segment));
    [end_s, number] = [part.end_s, info.segment];
  }
  const [start, ended] = [session.started_at, session.ended_at];
  if (start !== null && ended !== null && parts.length > 0) add(duration_s, (Date.parse(ended) - Date.parse(start)) / 1000, number, Infinity, END_S);
  return gaps;
}

/** The part that contains a time, or the last one before it; null before the first. */
export function partAt({ parts }: Timeline, at_s: number): Part | null {
  return parts.findLast(({ start_s }) => start_s <= at_s) ?? null;
}

/** Joins neighbouring samples of one source. A gap ends a span; its last sample is valid for one period. */
function spansOf(samples: Samples): Span[] {
  const spans: Span[] = [];
  let previous = -Infinity;
  for (const [index, time] of samples.time_s.entries()) {
    const source = SOURCES[samples.source[index] ?? -1] ?? "hold";
    const open = spans.at(-1);
    const joined = time - previous <= gapOf(samples);
    if (open !== undefined && joined) open.end_s = time;
    if (open === undefined || !joined || open.source !== source) spans.push({ start_s: time, end_s: time + samples.period_s, source });
    else open.end_s = time + samples.period_s;
    previous = time;
  }
  return spans;
}

/** After this time since the end of a session, its agent is not connected, and new parts are read on request only [ms]. */
const RECENT_MS = 3_600_000;

/** Whether new parts of a recording are expected soon. */
export function expectsMore(session: RecordedSession | null): boolean {
  if (session?.recording?.final === true) return false;
  return session?.ended_at === undefined || session.ended_at === null || serverNow() - Date.parse(session.ended_at) < RECENT_MS;
}
