import { useEffect, useState } from "preact/hooks";
import { clamp } from "../../../shared/lib/angles";
import type { PressedInputs } from "../model/pressed-inputs";
import type { Push } from "../model/steerable-parts";
import { texts } from "../texts";

/** Dead zone around the centre. */
const DEAD_ZONE = 0.1;
const NAME = "stick";

interface StickProps {
  inputs: PressedInputs<Push>;
  disabled: boolean;
}

/** A virtual stick: up is forward, sideways turns. It returns to the centre on release or pointer loss. */
export function VirtualStick({ inputs, disabled }: StickProps) {
  const [at, setAt] = useState<[number, number]>([0, 0]);
  const release = (): void => {
    setAt([0, 0]);
    inputs.release(NAME);
  };
  useEffect(() => {
    if (disabled) setAt([0, 0]);
    return () => inputs.release(NAME);
  }, [inputs, disabled]);
  const deflection = (event: PointerEvent & { currentTarget: HTMLElement }): [number, number] => {
    const box = event.currentTarget.getBoundingClientRect();
    const radius = box.width * 0.38;
    const x = (event.clientX - box.left - box.width / 2) / radius;
    const y = (box.top + box.height / 2 - event.clientY) / radius;
    const length = Math.max(1, Math.hypot(x, y));
    return [clamp(x / length, -1, 1), clamp(y / length, -1, 1)];
  };
  const part = ([x, y]: [number, number]): Push => {
    const small = Math.hypot(x, y) < DEAD_ZONE;
    return { forward: small ? 0 : y, turn: small ? 0 : -x, left: 0 };
  };
  return (
    <div
      class={`stick ${disabled ? "off" : ""}`}
      data-testid="stick"
      data-takes-keys
      role="application"
      aria-label={texts.steer.stick}
      aria-disabled={disabled}
      tabIndex={0}
      onPointerDown={(event) => {
        if (disabled || event.button !== 0) return;
        event.currentTarget.setPointerCapture(event.pointerId);
        const now = deflection(event);
        setAt(now);
        inputs.press(NAME, part(now));
      }}
      onPointerMove={(event) => {
        if (disabled || !event.currentTarget.hasPointerCapture(event.pointerId)) return;
        const now = deflection(event);
        setAt(now);
        inputs.update(NAME, part(now));
      }}
      onPointerUp={release}
      onPointerCancel={release}
      onLostPointerCapture={release}
      onBlur={release}
      onContextMenu={(event) => event.preventDefault()}
    >
      <span class="stick-mark up" aria-hidden="true">
        ↑
      </span>
      <span class="stick-mark down" aria-hidden="true">
        ↓
      </span>
      <span class="stick-mark left" aria-hidden="true">
        ↺
      </span>
      <span class="stick-mark right" aria-hidden="true">
        ↻
      </span>
      <span class="knob" style={{ "--x": String(at[0]), "--y": String(-at[1]) }} aria-hidden="true" />
    </div>
  );
}
