/** Whether a change of pose can be seen. */
import type { Targets } from "../../steering/model";

/** Less than this of a pixel is not seen. */
const SEEN_PX = 0.5;

/**
 * `drawn`: the pose that the picture shows, `null` before the first. `leverM`: the furthest that a part is from a joint
 * that turns it [m]; `pxPerM`: how large a metre is drawn. Joints carry one another, so what they move adds up.
 */
export function isVisibleChange(drawn: Targets | null, next: Targets | null, leverM: number, pxPerM: number): boolean {
  if (drawn === null || next === null) return drawn !== next;
  let sum = 0;
  for (const [name, at] of Object.entries(next)) sum += Math.abs(at - (drawn[name] ?? Infinity));
  return sum * leverM * pxPerM > SEEN_PX;
}
