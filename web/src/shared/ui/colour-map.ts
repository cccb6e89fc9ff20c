/**
 * Colours for values from 0 to 1. Lightness increases monotonically from blue to yellow, so that the map works with
 * colour blindness and in greyscale.
 */
type Colour = readonly [number, number, number];

const STEPS: readonly Colour[] = [
  [43, 16, 84],
  [58, 47, 132],
  [50, 83, 149],
  [38, 114, 152],
  [28, 145, 147],
  [52, 175, 126],
  [118, 202, 90],
  [190, 221, 56],
  [252, 232, 62],
];

/** Colour for missing values. */
export const MISSING_COLOUR: Colour = [128, 128, 128];

export function falseColour(value: number): Colour {
  const at = Math.min(1, Math.max(0, value)) * (STEPS.length - 1);
  const index = Math.min(STEPS.length - 2, Math.floor(at));
  const [from = MISSING_COLOUR, to = MISSING_COLOUR] = STEPS.slice(index, index + 2);
  const mix = (channel: 0 | 1 | 2): number => Math.round(from[channel] + (to[channel] - from[channel]) * (at - index));
  return [mix(0), mix(1), mix(2)];
}
