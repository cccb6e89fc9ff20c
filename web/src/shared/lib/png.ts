/**
 * Decodes 16-bit greyscale PNG images from depth cameras; browsers decode only 8 bits.
 * Supports ISO/IEC 15948 for this format, except interlacing.
 */
import { MessageError } from "../mqtt/checks";

/** Distance per pixel, in rows from the top [m]; 0: out of range. */
export interface DepthImage {
  width: number;
  height: number;
  depthM: Float32Array;
}

const SIGNATURE = [0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a];
const IHDR = 0x49484452;
const IDAT = 0x49444154;
const MAX_PIXELS = 1920 * 1080;
const BYTES = 2;
const MM_PER_M = 1000;
/** Of the compressed data, decompressed at once. Deflate reduces to a thousandth at most. */
const PIECE_BYTES = 1024;

/** Throws `MessageError`. */
export async function readDepth(file: Uint8Array): Promise<DepthImage> {
  if (!SIGNATURE.every((byte, index) => file[index] === byte)) throw new MessageError("the depth image is not a PNG file");
  const view = new DataView(file.buffer, file.byteOffset, file.byteLength);
  const parts: Uint8Array<ArrayBuffer>[] = [];
  let size: { width: number; height: number } | null = null;
  for (let at = SIGNATURE.length; at + 8 <= file.byteLength; ) {
    const length = view.getUint32(at);
    const chunk = view.getUint32(at + 4);
    const begin = at + 8;
    if (begin + length > file.byteLength) throw new MessageError("the depth image is truncated");
    if (chunk === IHDR && length === 13) size = header(view, begin);
    if (chunk === IDAT) parts.push(file.slice(begin, begin + length));
    at = begin + length + 4;
  }
  if (size === null) throw new MessageError("the depth image has no header");
  return { ...size, depthM: metres(unfiltered(await inflate(parts, size.height * (size.width * BYTES + 1)), size.width, size.height)) };
}

function header(view: DataView, at: number): { width: number; height: number } {
  const width = view.getUint32(at);
  const height = view.getUint32(at + 4);
  if (width < 1 || height < 1 || width * height > MAX_PIXELS) throw new MessageError("the depth image is empty or too large");
  // Bits per sample, then: greyscale, the standard compression and filter methods, not interlaced.
  const supported = [16, 0, 0, 0, 0].every((expected, index) => view.getUint8(at + 8 + index) === expected);
  if (!supported) throw new MessageError("the depth image is not 16-bit greyscale");
  return { width, height };
}

/** Stops when there are more than `expected` bytes: a small file can contain gigabytes. */
async function inflate(parts: Uint8Array<ArrayBuffer>[], expected: number): Promise<Uint8Array> {
  const reader = pieces(parts).pipeThrough(new DecompressionStream("deflate")).getReader();
  const out = new Uint8Array(expected);
  let filled = 0;
  try {
    for (let part = await reader.read(); !part.done; part = await reader.read()) {
      out.set(part.value, filled); // Throws `RangeError` beyond the end.
      filled += part.value.length;
    }
  } catch {
    await reader.cancel().catch(() => undefined);
    throw new MessageError("the depth image is corrupt");
  }
  if (filled !== expected) throw new MessageError("the depth image is corrupt");
  return out;
}

/** Small pieces: a browser may decompress a whole piece before the first byte of it can be read. */
function pieces(parts: Uint8Array<ArrayBuffer>[]): ReadableStream<Uint8Array<ArrayBuffer>> {
  const waiting = parts.flatMap((part) =>
    Array.from({ length: Math.ceil(part.length / PIECE_BYTES) }, (_, index) => part.subarray(index * PIECE_BYTES, (index + 1) * PIECE_BYTES)),
  );
  return new ReadableStream({
    pull(controller) {
      const next = waiting.shift();
      if (next === undefined) controller.close();
      else controller.enqueue(next);
    },
  });
}

/** Reverses the PNG row filters. */
function unfiltered(raw: Uint8Array, width: number, height: number): Uint8Array {
  const stride = width * BYTES;
  const out = new Uint8Array(height * stride);
  const at = (index: number): number => out[index] ?? 0;
  for (let row = 0; row < height; row += 1) {
    const filter = raw[row * (stride + 1)] ?? 0;
    for (let column = 0; column < stride; column += 1) {
      const index = row * stride + column;
      const left = column < BYTES ? 0 : at(index - BYTES);
      const up = row === 0 ? 0 : at(index - stride);
      const corner = column < BYTES || row === 0 ? 0 : at(index - stride - BYTES);
      out[index] = (raw[row * (stride + 1) + 1 + column] ?? 0) + predicted(filter, left, up, corner);
    }
  }
  return out;
}

function predicted(filter: number, left: number, up: number, corner: number): number {
  switch (filter) {
    case 0:
      return 0;
    case 1:
      return left;
    case 2:
      return up;
    case 3:
      return (left + up) >> 1;
    case 4:
      return paeth(left, up, corner);
    default:
      throw new MessageError("the depth image is corrupt");
  }
}

function paeth(left: number, up: number, corner: number): number {
  const guess = left + up - corner;
  const [byLeft, byUp, byCorner] = [Math.abs(guess - left), Math.abs(guess - up), Math.abs(guess - corner)];
  if (byLeft <= byUp && byLeft <= byCorner) return left;
  return byUp <= byCorner ? up : corner;
}

function metres(bytes: Uint8Array): Float32Array {
  const view = new DataView(bytes.buffer);
  return Float32Array.from({ length: bytes.length / BYTES }, (_, index) => view.getUint16(index * BYTES) / MM_PER_M);
}
