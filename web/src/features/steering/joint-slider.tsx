/** Sets one joint with a number or a slider with limits; shows the measured position. */
import { useRef, useState } from "preact/hooks";
import { degrees, radians } from "../../shared/lib/angles";
import type { Joint } from "../../shared/mqtt/protocol.generated";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

interface JointSliderProps {
  joint: Joint;
  /** Target position [rad]; `undefined`: unknown. */
  targetRad: number | undefined;
  /** Measured position [rad]; `undefined`: not measured. */
  measuredRad: number | undefined;
  /** Starts a new input: a press, a key that is not repeated, or a typed number. */
  onBegin?: () => void;
  /** Sets the target [rad]; `null`: disabled. */
  onSet: ((positionRad: number) => void) | null;
  /** The measurement is out of date. */
  old?: boolean;
  /** Whether keys move this joint. */
  selected?: boolean;
}

export function JointSlider({ joint, targetRad, measuredRad, onBegin, onSet, old = false, selected = false }: JointSliderProps) {
  const measured = measuredRad === undefined ? undefined : degrees(measuredRad);
  const target = targetRad === undefined ? undefined : degrees(targetRad);
  const lower = degrees(joint.lower_rad);
  const upper = degrees(joint.upper_rad);
  const pressed = useRef(false);
  // The slider shows its target, also if the target did not take over the position of the pointer.
  const [, redraw] = useState({});
  const set = (deg: number): void => onSet?.(radians(deg));
  const setTyped = (deg: number): void => {
    onBegin?.();
    set(deg);
  };
  const release = (): void => {
    pressed.current = false;
  };
  return (
    <div
      class={`joint ${old ? "old" : ""} ${selected ? "selected" : ""}`}
      role="group"
      aria-label={joint.label}
      aria-current={selected}
      data-testid={`joint-${joint.name}`}
    >
      <span class="joint-name">{joint.label}</span>
      <TargetField joint={joint} target={target} disabled={onSet === null} onSet={setTyped} />
      <span
        class="measured"
        data-testid={`measured-${joint.name}`}
        data-value={measured?.toFixed(3) ?? ""}
        title={texts.joints.measured(joint.label)}
      >
        {measured === undefined ? format.unknown : format.degrees(measured)}
      </span>
      <div class="track">
        <span class="limit quiet" aria-hidden="true">
          {format.wholeDegrees(lower)}
        </span>
        <span class="rail">
        <input
          type="range"
          data-testid={`slider-${joint.name}`}
          aria-label={texts.joints.slider(joint.label)}
          aria-valuetext={target === undefined ? format.unknown : format.degrees(target)}
          min={lower}
          max={upper}
          step="any"
          value={target ?? (lower + upper) / 2}
          disabled={onSet === null || target === undefined}
          onPointerDown={() => {
            pressed.current = true;
            onBegin?.();
          }}
          onPointerUp={release}
          onPointerCancel={release}
          onInput={(event) => {
            // Assistive technology sets values without a press: each is an input of its own.
            if (!pressed.current) onBegin?.();
            set(event.currentTarget.valueAsNumber);
            redraw({});
          }}
          onKeyDown={(event) => {
            const step = stepOf(event);
            if (step === null) return;
            event.preventDefault();
            if (!event.repeat) onBegin?.();
            if (target !== undefined && step !== 0) set(target + step);
          }}
        />
        {measured !== undefined && (
          <span class="marker" aria-hidden="true" style={{ "--at": String((measured - lower) / (upper - lower)) }} />
        )}
        </span>
        <span class="limit quiet" aria-hidden="true">
          {format.wholeDegrees(upper)}
        </span>
      </div>
    </div>
  );
}

/** Step of a key on a slider [°]; 0: suppressed key; `null`: unhandled key. */
function stepOf(event: KeyboardEvent): number | null {
  const size = event.shiftKey ? 10 : event.altKey ? 0.1 : 1;
  switch (event.key) {
    case "ArrowRight":
    case "ArrowUp":
      return size;
    case "ArrowLeft":
    case "ArrowDown":
      return -size;
    case "PageUp":
      return 10;
    case "PageDown":
      return -10;
    case "Home":
    case "End":
      // A single key must not move a joint across its whole range.
      return 0;
    default:
      return null;
  }
}

interface TargetFieldProps {
  joint: Joint;
  target: number | undefined;
  disabled: boolean;
  onSet: (deg: number) => void;
}

/** The target as a number. Enter applies the input; leaving the field discards it. */
function TargetField({ joint, target, disabled, onSet }: TargetFieldProps) {
  const [typed, setTyped] = useState<string | null>(null);
  const field = useRef<HTMLInputElement>(null);
  const shown = target === undefined ? "" : format.oneDigit(target);
  const commit = (): void => {
    const value = Number(typed?.replace(",", "."));
    if (typed !== null && typed.trim() !== "" && Number.isFinite(value)) onSet(value);
    setTyped(null);
    field.current?.select();
  };
  return (
    <span class="target">
      <input
        ref={field}
        type="text"
        inputMode="decimal"
        data-testid={`target-${joint.name}`}
        data-value={target?.toFixed(3) ?? ""}
        aria-label={texts.joints.target(joint.label)}
        value={typed ?? shown}
        disabled={disabled}
        onInput={(event) => setTyped(event.currentTarget.value)}
        onBlur={() => setTyped(null)}
        onKeyDown={(event) => {
          if (event.key === "Enter") commit();
        }}
      />
      <span aria-hidden="true">{texts.joints.unit}</span>
    </span>
  );
}
