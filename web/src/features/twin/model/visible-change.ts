import type { Targets } from "../../steering/model";

/** Smaller changes are invisible [px]. */
const SEEN_PX = 0.5;

/**
 * Whether a change of pose is visible. `drawn`: the displayed pose, `null`: none. `leverM`: maximum distance of a part
 * from its joints [m]; `pxPerM`: scale. Joint motions add up.
 */
export function isVisibleChange(drawn: Targets | null, next: Targets | null, leverM: number, pxPerM: number): boolean {
  if (drawn === null || next === null) return drawn !== next;
  let sum = 0;
  for (const [name, at] of Object.entries(next)) sum += Math.abs(at - (drawn[name] ?? Infinity));
  return sum * leverM * pxPerM > SEEN_PX;
}
