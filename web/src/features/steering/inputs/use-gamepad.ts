/** Looks at the gamepads of this computer. A browser tells of none until a button of it has been pressed. */
import { useSignal, useSignalEffect, type ReadonlySignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { readPad, type PadReading } from "../model/gamepad-mapping";
import type { PressedInputs } from "../model/pressed-inputs";

/** Not with the page's frames: those wait where drawing is slow, and a button that was let go must not [ms]. */
const LOOK_EVERY_MS = 20;

export interface PadWatch {
  /** The newest of the first gamepad that can be read; `null`: there is none. */
  reading: ReadonlySignal<PadReading | null>;
  /** What is to be said of gamepads; empty while there was none. */
  news: ReadonlySignal<PadNews | null>;
}

export type PadNews = { kind: "connected" | "gone"; id: string } | { kind: "unknown"; id: string };

/** Look at gamepads while `active`; `onStop` hears of every press of the button that stops. */
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

/** Hold what a gamepad's sticks say while its dead-man button is held; `null` from `part`: nothing for this panel. */
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
