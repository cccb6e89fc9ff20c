/** A decoded segment: all rows, events and images of at most one minute. */
import type { KnownEvent } from "../../../../shared/mqtt/parse-messages";
import type { Samples } from "./samples";

/** Images of one camera in order of time, in one buffer. */
export interface Images {
  topic: string;
  time_s: Float64Array;
  /** Content type of each image, such as `image/jpeg`. */
  types: readonly string[];
  /** Image `n` is at `offsets[n]` to `offsets[n + 1]`. */
  offsets: Uint32Array;
  data: Uint8Array<ArrayBuffer>;
}

export interface TimedEvent {
  /** Since the start of the session [s]. */
  time_s: number;
  event: KnownEvent;
}

export interface Segment extends Samples {
  segment: number;
  epoch: number;
  /** Monotonic clock of the agent at the start of the session [ms]. */
  started_tick_ms: number;
  requested_rad: Float64Array;
  commanded_rad: Float64Array;
  /** Three values in each row: forward [m/s], left [m/s], turn [rad/s]. */
  twist: Float64Array;
  sequence: Float64Array;
  setpoint_sequence: Float64Array;
  /** 0: the row has no setpoint of an operator. */
  seen_tick_ms: Float64Array;
  loop_age_ms: Float64Array;
  limited: readonly (readonly string[])[];
  events: readonly TimedEvent[];
  images: readonly Images[];
  /** `excerpt`: only the rows around one time were decoded. `truncated`: the end of the file is missing. */
  extent: "whole" | "excerpt" | "truncated";
  /** Memory [bytes]. */
  bytes: number;
}

/** All buffers of a segment, to move them out of a worker without a copy. */
export function buffersOf(segment: Segment): ArrayBuffer[] {
  const parts: object[] = [segment, ...segment.images];
  const columns = parts.flatMap((part) => Object.values(part) as unknown[]);
  return columns.flatMap((column) => (ArrayBuffer.isView(column) ? [column.buffer as ArrayBuffer] : []));
}
