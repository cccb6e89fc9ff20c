/** Connects pressed inputs to a setpoint stream: releasing any of them ends the stream. */
import { effect } from "@preact/signals";
import { useEffect, useMemo, useRef } from "preact/hooks";
import { PressedInputs } from "../model/pressed-inputs";
import type { SetpointStreamer } from "../model/setpoint-streamer";
import type { Velocity } from "../model/steerable-parts";

/**
 * What is held of a panel, as the velocity that `asked` makes of it.
 *
 * @param streamer There while this page may move the robot.
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
  // What it means may have changed: the speed, the axes.
  useEffect(() => {
    if (held.any) held.again();
  });
  useEffect(
    () =>
      effect(() => {
        // Ended by something else: what is still pressed must not begin anew by itself.
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
