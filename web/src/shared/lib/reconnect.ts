/** When connections are opened again. */

const BACKOFF_MS = [250, 500, 1_000, 2_000, 4_000] as const;
const REFRESH_MARGIN_MS = 60_000;
const MIN_REFRESH_MS = 1_000;

/** Delay before the next attempt, spread so that many pages do not reconnect at once [ms]. */
export function retryDelayMs(attempts: number): number {
  const step = BACKOFF_MS[Math.min(attempts, BACKOFF_MS.length - 1)] ?? 4_000;
  return step * (0.75 + Math.random() / 2);
}

/** Delay until credentials with this lifetime are replaced, `spentMs` after they were requested [ms]. */
export function refreshDelayMs(lifetimeS: number, spentMs: number): number {
  const lifetimeMs = lifetimeS * 1000;
  return Math.max(lifetimeMs - Math.min(REFRESH_MARGIN_MS, lifetimeMs / 3) - spentMs, MIN_REFRESH_MS);
}
