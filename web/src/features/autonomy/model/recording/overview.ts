/** The overview of a segment: five samples a second, and events. Same format as device_agent/runtime/recording/format.py. */
import { MODES, type Samples, SOURCES } from "./samples";

const SEVERITIES = ["info", "warning", "error"] as const;

/** An event on the time axis. */
export interface TimelineEvent {
  /** Since the start of the session [s]. */
  time_s: number;
  kind: string;
  severity: (typeof SEVERITIES)[number];
  text: string;
}

export interface Overview extends Samples {
  /** In order of time; null: an older agent has not written them. */
  events: readonly TimelineEvent[] | null;
  /** Number of events that are only in the segment. */
  events_omitted: number;
}

/** Time between two samples [s]. */
export const OVERVIEW_S = 0.2;

/** A file of a recording that cannot be read. */
export class FileError extends Error {
  override name = "FileError";
}

interface Content {
  joints: string[];
  time_s: number[];
  position_rad: number[][];
  applied_rad: number[][];
  source: string[];
  mode: string[];
  events?: TimelineEvent[] | null;
  events_omitted?: number;
}

/** The content of an overview. Throws `FileError`. */
export function readOverview(content: Uint8Array): Overview {
  let overview: Content;
  try {
    overview = JSON.parse(new TextDecoder().decode(content)) as Content;
  } catch {
    throw new FileError("The overview is not valid JSON.");
  }
  const { joints, time_s: times, source, mode } = overview;
  const columns: unknown[] = [times, overview.position_rad, overview.applied_rad, source, mode];
  const count = Array.isArray(times) ? times.length : -1;
  if (!Array.isArray(joints) || columns.some((column) => !Array.isArray(column) || column.length !== count)) {
    throw new FileError("The columns of the overview have different lengths.");
  }
  return {
    joints,
    time_s: Float64Array.from(times),
    position_rad: flat(overview.position_rad, joints.length),
    applied_rad: flat(overview.applied_rad, joints.length),
    source: codes(source, SOURCES),
    mode: codes(mode, MODES),
    period_s: OVERVIEW_S,
    events: eventsOf(overview.events ?? null),
    events_omitted: overview.events_omitted ?? 0,
  };
}

function eventsOf(events: readonly TimelineEvent[] | null): readonly TimelineEvent[] | null {
  const readable = ({ time_s, kind, severity, text }: TimelineEvent): boolean =>
    Number.isFinite(time_s) && typeof kind === "string" && SEVERITIES.includes(severity) && typeof text === "string";
  if (events !== null && !(Array.isArray(events) && events.every(readable))) throw new FileError("An event of the overview is not readable.");
  return events;
}

/** Rows of joints as one column. A value that is not known is null in JSON, and NaN here. Throws `FileError` if a row has another number of joints. */
export function flat(rows: readonly (readonly (number | null)[])[], joints: number): Float64Array {
  const values = new Float64Array(rows.length * joints);
  rows.forEach((row, index) => {
    if (row.length !== joints) throw new FileError(`A row has ${row.length} joints instead of ${joints}.`);
    row.forEach((value, joint) => (values[index * joints + joint] = value ?? NaN));
  });
  return values;
}

/** Names as indices of a list. Throws `FileError` for an unknown name. */
export function codes(names: readonly string[], known: readonly string[]): Uint8Array {
  return Uint8Array.from(names, (name) => {
    const code = known.indexOf(name);
    if (code < 0) throw new FileError("The file has a value that this version of the console does not know.");
    return code;
  });
}
