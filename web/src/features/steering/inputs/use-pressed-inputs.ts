/** Connects pressed inputs to a setpoint stream: releasing any of them ends the stream. */
import { effect } from "@preact/signals";
import { useEffect, useMemo, useRef } from "preact/hooks";
import { PressedInputs } from "../model/pressed-inputs";
import type { SetpointStreamer } from "../model/setpoint-streamer";
import type { Velocity } from "../model/steerable-parts";

/**
 * The pressed inputs of a panel. `asked` converts them to a velocity.
 *
 * @param streamer Set while this page may move the robot.
 */
export function usePressedInputs<T>(streamer: SetpointStreamer | null, asked: (parts: readonly T[]) => Velocity): PressedInputs<T> {
  const newest = useRef({ streamer, asked });
  newest.current = { streamer, asked };
  const held = useMemo(
    () =>
      new PressedInputs<T>((parts) => {
        const { streamer: to, asked: ask } = newest.current;
        if (parts.length === 0) to?.letGo();
        else to?.hold(ask(parts));
      }),
    [],
  );
  // The speed or axes may have changed: send the velocity again.
  useEffect(() => {
    if (held.any) held.again();
  });
  useEffect(
    () =>
      effect(() => {
        // The stream ended for another reason: inputs that are still pressed must not restart it.
        if ((streamer?.velocity.value ?? null) === null) held.spend();
      }),
    [held, streamer],
  );
  useEffect(() => {
    const drop = (): void => held.releaseAll();
    addEventListener("blur", drop);
    document.addEventListener("visibilitychange", drop);
    return () => {
      removeEventListener("blur", drop);
      document.removeEventListener("visibilitychange", drop);
      held.releaseAll();
      streamer?.letGo();
    };
  }, [held, streamer]);
  return held;
}
