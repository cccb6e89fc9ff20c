/** Connects pressed inputs to a setpoint stream: releasing any of them ends the stream. */
import { effect } from "@preact/signals";
import { useEffect, useMemo, useRef } from "preact/hooks";
import { PressedInputs } from "../model/pressed-inputs";
import type { SetpointStreamer } from "../model/setpoint-streamer";
import type { Velocity } from "../model/steerable-parts";

/**
 * The pressed inputs of a panel. `toVelocity` converts them to a velocity.
 *
 * @param streamer Set while this page may move the robot.
 */
export function usePressedInputs<T>(streamer: SetpointStreamer | null, toVelocity: (parts: readonly T[]) => Velocity): PressedInputs<T> {
  const newest = useRef({ streamer, toVelocity });
  newest.current = { streamer, toVelocity };
  const inputs = useMemo(
    () =>
      new PressedInputs<T>(
        (parts) => {
          const { streamer: to, toVelocity: convert } = newest.current;
          if (parts.length === 0) to?.release();
          else to?.setVelocity(convert(parts));
        },
        () => newest.current.streamer?.begin(),
      ),
    [],
  );
  // The speed or axes may have changed: send the velocity again.
  useEffect(() => {
    if (inputs.any) inputs.notify();
  });
  useEffect(
    () =>
      effect(() => {
        // The stream ended for another reason: inputs that are still pressed must not restart it.
        if ((streamer?.velocity.value ?? null) === null) inputs.spend();
      }),
    [inputs, streamer],
  );
  useEffect(() => {
    const releaseInputs = (): void => inputs.releaseAll();
    addEventListener("blur", releaseInputs);
    document.addEventListener("visibilitychange", releaseInputs);
    return () => {
      removeEventListener("blur", releaseInputs);
      document.removeEventListener("visibilitychange", releaseInputs);
      inputs.releaseAll();
      streamer?.release();
    };
  }, [inputs, streamer]);
  return inputs;
}
