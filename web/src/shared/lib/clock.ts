/** The page's monotonic clock, and its offset from the server's wall clock. */
import { signal, type ReadonlySignal } from "@preact/signals-core";

/** The page's monotonic clock [ms]. */
export function now(): number {
  return performance.now();
}

const tick = signal(now());

/** `now()`, updated four times per second. Displayed ages subscribe to it. */
export const clock: ReadonlySignal<number> = tick;

/** Starts the clock updates; returns a function that stops them. */
export function startClock(): () => void {
  const timer = setInterval(() => (tick.value = now()), 250);
  return () => {
    clearInterval(timer);
  };
}

let serverOffsetMs: number | null = null;
let bestRoundTripMs = Infinity;

/** Updates the clock offset from a response; the response with the shortest round trip is used. */
export function updateServerTime(serverMs: number, sentAt: number, receivedAt: number): void {
  const roundTripMs = receivedAt - sentAt;
  if (Number.isFinite(serverMs) && roundTripMs <= bestRoundTripMs) {
    bestRoundTripMs = roundTripMs;
    serverOffsetMs = serverMs - (sentAt + receivedAt) / 2;
  }
}

/** Converts server wall-clock time [ms since 1970] to the page's monotonic clock [ms]. */
export function toPageClock(serverMs: number): number {
  return serverMs - (serverOffsetMs ?? Date.now() - now());
}

/** The estimated current server time [ms since 1970]. */
export function serverNow(): number {
  return now() + (serverOffsetMs ?? Date.now() - now());
}
