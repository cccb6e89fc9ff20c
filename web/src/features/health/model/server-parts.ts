/** Order of the server's parts on the page. */
import type { PartStatus, ServerPart } from "../../../shared/api/health";

const RANK: Readonly<Record<PartStatus, number>> = { failed: 0, degraded: 1, ok: 2 };

/** Worst first; otherwise in the order of the server. */
export function worstFirst(parts: readonly ServerPart[]): ServerPart[] {
  return [...parts].sort((one, other) => RANK[one.status] - RANK[other.status]);
}
