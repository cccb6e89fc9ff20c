/**
 * Limits signal updates to one per animation frame. A slow page draws only the newest value.
 */
import { batch, type ReadonlySignal, type Signal, useSignal, useSignalEffect } from "@preact/signals";

/** The next value of each signal. */
const next = new Map<Signal<unknown>, unknown>();

/** The value of `source` at the newest frame. */
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
