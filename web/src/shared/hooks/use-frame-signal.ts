/**
 * What is heard more often than it can be drawn is drawn once a frame. A page that falls behind then draws what is
 * newest, and nothing of what came in between.
 */
import { batch, type ReadonlySignal, type Signal, useSignal, useSignalEffect } from "@preact/signals";

/** What each signal is to be with the next frame. */
const next = new Map<Signal<unknown>, unknown>();

/** `source`, as it was at the newest frame. */
export function useFrameSignal<T>(source: ReadonlySignal<T>): ReadonlySignal<T> {
  const drawn = useSignal(source.peek());
  useSignalEffect(() => {
    if (next.size === 0) requestAnimationFrame(draw);
    next.set(drawn, source.value);
  });
  return drawn;
}

function draw(): void {
  batch(() => {
    for (const [drawn, value] of next) drawn.value = value;
  });
  next.clear();
}
