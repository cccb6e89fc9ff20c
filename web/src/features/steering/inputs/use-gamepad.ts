/** Polls the computer's gamepads. A browser reports a gamepad only after a button press. */
import { useSignal, useSignalEffect, type ReadonlySignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { readPad, type PadReading } from "../model/gamepad-mapping";
import type { PressedInputs } from "../model/pressed-inputs";

/** Polling interval. Independent of animation frames, which slow drawing would delay [ms]. */
const LOOK_EVERY_MS = 20;

export interface PadWatch {
  /** The newest reading of the first usable gamepad; `null`: none. */
  reading: ReadonlySignal<PadReading | null>;
  /** The newest gamepad notice; `null`: none. */
  news: ReadonlySignal<PadNews | null>;
}

export type PadNews = { kind: "connected" | "gone"; id: string } | { kind: "unknown"; id: string };

/** Polls gamepads while `active`; `onStop` is called for each press of the Stop button. */
export function useGamepad(active: boolean, onStop: () => void): PadWatch {
  const reading = useSignal<PadReading | null>(null);
  const news = useSignal<PadNews | null>(null);
  const stop = useRef(onStop);
  stop.current = onStop;
  useEffect(() => {
    if (!active || typeof navigator.getGamepads !== "function") return;
    let said = "";
    const look = (): void => {
      const pads = navigator.getGamepads().filter((pad) => pad?.connected === true);
      const next = pads.map(readPad).find((one) => one !== null) ?? null;
      const before = reading.peek();
      if (next?.id !== before?.id) {
        if (next !== null) news.value = { kind: "connected", id: next.id };
        else if (before !== null) news.value = { kind: "gone", id: before.id };
      }
      const odd = next === null ? (pads[0]?.id ?? "") : "";
      if (odd !== "" && odd !== said) news.value = { kind: "unknown", id: odd };
      said = odd;
      if (next?.stop === true && before?.stop !== true) stop.current();
      if (JSON.stringify(next) !== JSON.stringify(before)) reading.value = next;
    };
    look();
    const timer = setInterval(look, LOOK_EVERY_MS);
    return () => {
      clearInterval(timer);
      reading.value = null;
    };
  }, [active]);
  return { reading, news };
}

/** Applies a gamepad's sticks while its dead-man button is held. */
export function useGamepadInputs<T>(watch: PadWatch, held: PressedInputs<T>, part: (reading: PadReading) => T): void {
  const was = useRef(false);
  const newest = useRef(part);
  newest.current = part;
  useSignalEffect(() => {
    const reading = watch.reading.value;
    if (reading?.held !== true || reading.stop) {
      held.release("gamepad");
      was.current = false;
    } else if (was.current) {
      held.keep("gamepad", newest.current(reading));
    } else {
      was.current = true;
      held.press("gamepad", newest.current(reading));
    }
  });
}
