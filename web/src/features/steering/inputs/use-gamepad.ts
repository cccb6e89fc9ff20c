/** Polls the computer's gamepads. A browser reports a gamepad only after a button press. */
import { useSignal, useSignalEffect, type ReadonlySignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { readPad, type PadReading } from "../model/gamepad-mapping";
import type { PressedInputs } from "../model/pressed-inputs";

/** Polling interval. Independent of animation frames, which slow drawing would delay [ms]. */
const POLL_INTERVAL_MS = 20;

export interface GamepadState {
  /** The newest reading of the first usable gamepad; `null`: none. */
  reading: ReadonlySignal<PadReading | null>;
  /** The newest gamepad notice; `null`: none. */
  notice: ReadonlySignal<GamepadNotice | null>;
}

export type GamepadNotice = { kind: "connected" | "disconnected"; id: string } | { kind: "unknown"; id: string };

/** Polls gamepads while `active`; `onStop` is called for each press of the Stop button. */
export function useGamepad(active: boolean, onStop: () => void): GamepadState {
  const reading = useSignal<PadReading | null>(null);
  const notice = useSignal<GamepadNotice | null>(null);
  const stop = useRef(onStop);
  stop.current = onStop;
  useEffect(() => {
    if (!active || typeof navigator.getGamepads !== "function") return;
    let reportedId = "";
    const poll = (): void => {
      const pads = navigator.getGamepads().filter((pad) => pad?.connected === true);
      const next = pads.map(readPad).find((one) => one !== null) ?? null;
      const before = reading.peek();
      if (next?.id !== before?.id) {
        if (next !== null) notice.value = { kind: "connected", id: next.id };
        else if (before !== null) notice.value = { kind: "disconnected", id: before.id };
      }
      const unsupportedId = next === null ? (pads[0]?.id ?? "") : "";
      if (unsupportedId !== "" && unsupportedId !== reportedId) notice.value = { kind: "unknown", id: unsupportedId };
      reportedId = unsupportedId;
      if (next?.stop === true && before?.stop !== true) stop.current();
      if (JSON.stringify(next) !== JSON.stringify(before)) reading.value = next;
    };
    poll();
    const timer = setInterval(poll, POLL_INTERVAL_MS);
    return () => {
      clearInterval(timer);
      reading.value = null;
    };
  }, [active]);
  return { reading, notice };
}

/** Applies a gamepad's sticks while its dead-man button is held. */
export function useGamepadInputs<T>(gamepad: GamepadState, inputs: PressedInputs<T>, part: (reading: PadReading) => T): void {
  const wasEnabled = useRef(false);
  const newest = useRef(part);
  newest.current = part;
  useSignalEffect(() => {
    const reading = gamepad.reading.value;
    if (reading?.enabled !== true || reading.stop) {
      inputs.release("gamepad");
      wasEnabled.current = false;
    } else if (wasEnabled.current) {
      inputs.update("gamepad", newest.current(reading));
    } else {
      wasEnabled.current = true;
      inputs.press("gamepad", newest.current(reading));
    }
  });
}
