/** Colour scale of depth images. */
import { falseColour, MISSING_COLOUR } from "../../../shared/ui/colour-map";
import type { DepthImage } from "../../../shared/lib/png";

/** Distances at the ends of the colour scale [m]. */
export interface DepthScale {
  nearM: number;
  farM: number;
}

const STEPS = 256;
/** A live scale that is wider than the image by more than this on one side is set anew [m]. */
const TOO_WIDE_M = 2;

/**
 * The scale for an image, in steps of 0.1 m. It keeps the scale of the previous image while that fits, so that colours do
 * not flicker. `null`: the image has no echo.
 */
export function scaleOf({ depthM }: DepthImage, previous: DepthScale | null): DepthScale | null {
  let [nearest, furthest] = [Infinity, 0];
  for (const m of depthM) {
    if (m > 0 && m < nearest) nearest = m;
    if (m > furthest) furthest = m;
  }
  if (furthest === 0) return previous;
  const own = { nearM: Math.floor(nearest * 10) / 10, farM: Math.ceil(furthest * 10) / 10 };
  if (previous === null || own.nearM - previous.nearM > TOO_WIDE_M || previous.farM - own.farM > TOO_WIDE_M) return own;
  return { nearM: Math.min(own.nearM, previous.nearM), farM: Math.max(own.farM, previous.farM) };
}

/** The image in false colours: red, green, blue and opacity of each pixel. */
export function coloured({ depthM }: DepthImage, { nearM, farM }: DepthScale): Uint8ClampedArray<ArrayBuffer> {
  const table = Uint32Array.from({ length: STEPS }, (_, step) => packed(falseColour(step / (STEPS - 1))));
  const missing = packed(MISSING_COLOUR);
  const slope = (STEPS - 1) / Math.max(0.001, farM - nearM);
  const out = new Uint32Array(depthM.length);
  depthM.forEach((m, index) => {
    const step = Math.min(STEPS - 1, Math.max(0, Math.round((m - nearM) * slope)));
    out[index] = m > 0 ? (table[step] ?? missing) : missing;
  });
  return new Uint8ClampedArray(out.buffer);
}

/** A pixel as `ImageData` stores it; all supported machines are little-endian. */
function packed([red, green, blue]: readonly [number, number, number]): number {
  return ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
}
