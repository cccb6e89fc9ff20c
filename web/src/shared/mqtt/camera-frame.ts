/** Frames of `cam/{name}`: a 20-byte header, then the JPEG. Same format as device_agent/protocol/camera_frames.py. */
import { MessageError } from "./checks";

export interface CameraFrame {
  /** Increases until the agent restarts. */
  sequence: number;
  /** Capture time on the agent's monotonic clock [ms]. */
  tickMs: number;
  /** Image size [px]. */
  width: number;
  height: number;
  jpeg: Uint8Array;
}

const HEADER_BYTES = 20;
const MAX_BYTES = 128 * 1024;
/** `TS`, version 1, JPEG. */
const MAGIC = 0x54530101;
const JPEG_BEGINS = 0xffd8;

/** Throws `MessageError`. */
export function readFrame(payload: Uint8Array): CameraFrame {
  const validLength = payload.byteLength > HEADER_BYTES + 2 && payload.byteLength <= MAX_BYTES;
  if (!validLength) throw new MessageError(`a camera frame cannot have ${payload.byteLength} bytes`);
  const view = new DataView(payload.buffer, payload.byteOffset, payload.byteLength);
  if (view.getUint32(0) !== MAGIC) throw new MessageError("the frame header does not have version 1");
  if (view.getUint16(HEADER_BYTES) !== JPEG_BEGINS) throw new MessageError("the frame is not a JPEG image");
  return {
    sequence: view.getUint32(4),
    tickMs: Number(view.getBigUint64(8)),
    width: view.getUint16(16),
    height: view.getUint16(18),
    jpeg: payload.subarray(HEADER_BYTES),
  };
}
