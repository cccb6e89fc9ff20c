/** Keyboard control of a robot: key handlers and the list of keys. */
import { signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import type { PressedInputs } from "../model/pressed-inputs";
import type { SteeringMode } from "../model/steerable-parts";
import { texts } from "../texts";

const STORAGE_KEY = "telescope-keys";
/** Whether keys work everywhere on the page, or only while the focus is on the robot's controls. */
const everywhere = signal(localStorage.getItem(STORAGE_KEY) !== "off");

const TEXT = 'input:not([type="range"], [type="checkbox"], [type="radio"]), textarea, select, [contenteditable], .cm-editor';
/** Elements that use the arrow keys themselves. */
const ARROWS_TAKEN = 'input, [role="tab"], [role="radiogroup"], [tabindex="0"]:not([data-takes-keys])';

/** Whether a key event controls the robot, and not the focused element. */
function controlsRobot(event: KeyboardEvent): boolean {
  if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return false;
  const at = event.target instanceof Element ? event.target : null;
  if (at === null) return true;
  if (at.closest(TEXT) !== null) return false;
  if (event.code.startsWith("Arrow") && at.closest(ARROWS_TAKEN) !== null) return false;
  return everywhere.value || at.closest("[data-takes-keys]") !== null;
}

/** Handles keys while `active`. If `onKey` returns `true`, the default action is suppressed. */
export function useKey(active: boolean, onKey: (event: KeyboardEvent) => boolean): void {
  const newest = useRef(onKey);
  newest.current = onKey;
  useEffect(() => {
    if (!active) return;
    const onKeyDown = (event: KeyboardEvent): void => {
      if (controlsRobot(event) && newest.current(event)) event.preventDefault();
    };
    addEventListener("keydown", onKeyDown);
    return () => removeEventListener("keydown", onKeyDown);
  }, [active]);
}

/** Presses an input while its key is down. The key's release is detected even if the focus has moved. */
export function useHeldKeys<T>(active: boolean, inputs: PressedInputs<T>, map: Readonly<Record<string, T>>): void {
  useKey(active, (event) => {
    const part = map[event.code];
    if (part === undefined) return false;
    if (!event.repeat) inputs.press(event.code, part);
    return true;
  });
  useEffect(() => {
    if (!active) return;
    const onKeyUp = (event: KeyboardEvent): void => {
      if (event.code in map) inputs.release(event.code);
    };
    addEventListener("keyup", onKeyUp, { capture: true });
    return () => {
      removeEventListener("keyup", onKeyUp, { capture: true });
      inputs.releaseAll();
    };
  }, [active, inputs, map]);
}

/** The keys of the visible panel, shown inline so that nothing covers Stop. */
export function KeyboardHelp({ mode }: { mode: SteeringMode }) {
  const rows = [...texts.steer.keys[mode], ...texts.steer.keys.always];
  return (
    <div class="keys" data-testid="keys">
      <dl>
        {rows.map(([keys, what]) => (
          <div key={keys.join()}>
            <dt>
              {keys.map((key) => (
                <kbd key={key}>{key}</kbd>
              ))}
            </dt>
            <dd>{what}</dd>
          </div>
        ))}
      </dl>
      <label class="check">
        <input
          type="checkbox"
          data-testid="keys-everywhere"
          checked={everywhere.value}
          onChange={(event) => {
            everywhere.value = event.currentTarget.checked;
            localStorage.setItem(STORAGE_KEY, everywhere.value ? "on" : "off");
          }}
        />
        {texts.steer.everywhere}
      </label>
      <p class="quiet small">{texts.steer.padKeys[mode]}</p>
    </div>
  );
}
