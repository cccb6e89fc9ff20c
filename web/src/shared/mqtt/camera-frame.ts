/**
 * Frames of `cam/{name}`: a 20-byte header, then the content. Same format as device_agent/protocol/camera_frames.py.
 */
import { MessageError } from "./checks";

export type FrameKind = "colour" | "depth" | "scan" | "people";

export interface CameraFrame {
  kind: FrameKind;
  /** Increases until the agent restarts. */
  sequence: number;
  /** Time of the measurement on the agent's monotonic clock [ms]. */
  tickMs: number;
  /** Picture size [px], or the number of beams or people. */
  width: number;
  height: number;
  /** JPEG, 16-bit PNG, or JSON. */
  content: Uint8Array;
}

const HEADER_BYTES = 20;
const MAX_BYTES = 128 * 1024;
/** `TS`, version 1. */
const MAGIC = 0x545301;
/** By the kind's number in the header: its name, and how its content begins. */
const KINDS: readonly (readonly [FrameKind, number, string])[] = [
  ["colour", 0xffd8, "a JPEG image"],
  ["depth", 0x8950, "a PNG image"],
  ["scan", 0x7b22, "JSON"],
  ["people", 0x7b22, "JSON"],
];

/** A frame of the described kind. Throws `MessageError`. */
export function readFrame(payload: Uint8Array, described: FrameKind): CameraFrame {
  const validLength = payload.byteLength > HEADER_BYTES + 2 && payload.byteLength <= MAX_BYTES;
  if (!validLength) throw new MessageError(`a camera frame cannot have ${payload.byteLength} bytes`);
  const view = new DataView(payload.buffer, payload.byteOffset, payload.byteLength);
  if (view.getUint32(0) >> 8 !== MAGIC) throw new MessageError("the frame header does not have version 1");
  const found = KINDS[view.getUint8(3) - 1];
  if (found === undefined) throw new MessageError("the frame is of an unknown kind");
  const [kind, begins, format] = found;
  if (kind !== described) throw new MessageError(`the frame has the kind ${kind}, not ${described}`);
  if (view.getUint16(HEADER_BYTES) !== begins) throw new MessageError(`the frame of the kind ${kind} is not ${format}`);
  return {
    kind,
    sequence: view.getUint32(4),
    tickMs: Number(view.getBigUint64(8)),
    width: view.getUint16(16),
    height: view.getUint16(18),
    content: payload.subarray(HEADER_BYTES),
  };
}
