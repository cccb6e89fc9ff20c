/** The page's own monotonic clock, and how far the server's wall clock is from the page's. */
import { signal, type ReadonlySignal } from "@preact/signals-core";

/** The page's monotonic clock [ms]. */
export function now(): number {
  return performance.now();
}

const beat = signal(now());

/** `now()`, four times a second: what shows an age reads this, so that ages grow on the page by themselves. */
export const clock: ReadonlySignal<number> = beat;

/** Start the beat; returns what stops it. */
export function startClock(): () => void {
  const timer = setInterval(() => (beat.value = now()), 250);
  return () => {
    clearInterval(timer);
  };
}

let serverOffsetMs: number | null = null;
let bestRoundTripMs = Infinity;

/** Learn the server's clock from one answer; the answer with the smallest round trip is believed. */
export function learnServerTime(serverMs: number, askedAt: number, answeredAt: number): void {
  const roundTripMs = answeredAt - askedAt;
  if (Number.isFinite(serverMs) && roundTripMs <= bestRoundTripMs) {
    bestRoundTripMs = roundTripMs;
    serverOffsetMs = serverMs - (askedAt + answeredAt) / 2;
  }
}

/** A wall-clock time of the server [ms since 1970] on the page's monotonic clock [ms]. */
export function onThisClock(serverMs: number): number {
  return serverMs - (serverOffsetMs ?? Date.now() - now());
}

/** The server's wall clock now [ms since 1970], as far as it is known. */
export function serverNow(): number {
  return now() + (serverOffsetMs ?? Date.now() - now());
}
