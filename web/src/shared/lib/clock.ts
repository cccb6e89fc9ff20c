/** The page's monotonic clock, and its offset from the server's wall clock. */
import { signal, type ReadonlySignal } from "@preact/signals-core";

/** The page's monotonic clock [ms]. */
export function now(): number {
  return performance.now();
}

const beat = signal(now());

/** `now()`, updated four times per second. Displayed ages subscribe to it. */
export const clock: ReadonlySignal<number> = beat;

/** Starts the clock updates; returns a function that stops them. */
export function startClock(): () => void {
  const timer = setInterval(() => (beat.value = now()), 250);
  return () => {
    clearInterval(timer);
  };
}

let serverOffsetMs: number | null = null;
let bestRoundTripMs = Infinity;

/** Updates the clock offset from a response; the response with the shortest round trip is used. */
export function learnServerTime(serverMs: number, askedAt: number, answeredAt: number): void {
  const roundTripMs = answeredAt - askedAt;
  if (Number.isFinite(serverMs) && roundTripMs <= bestRoundTripMs) {
    bestRoundTripMs = roundTripMs;
    serverOffsetMs = serverMs - (askedAt + answeredAt) / 2;
  }
}

/** Converts server wall-clock time [ms since 1970] to the page's monotonic clock [ms]. */
export function onThisClock(serverMs: number): number {
  return serverMs - (serverOffsetMs ?? Date.now() - now());
}

/** The estimated current server time [ms since 1970]. */
export function serverNow(): number {
  return now() + (serverOffsetMs ?? Date.now() - now());
}
