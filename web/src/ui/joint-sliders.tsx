import { useRef, useState } from "preact/hooks";
import { degrees, radians } from "../core/angles";
import type { Control } from "../core/control";
import type { DeviceStore } from "../core/device";
import type { Joint } from "../core/protocol";
import type { SetpointStreamer } from "../core/streamer";
import { texts } from "../texts";
import { Card } from "./parts";

interface JointSlidersProps {
  device: DeviceStore;
  control: Control;
}

export function JointSliders({ device, control }: JointSlidersProps) {
  const description = device.description.value;
  const joints = description?.joints ?? [];
  const streamer = control.streamer.value;
  const blocked = whyBlocked(device, control);
  return (
    <Card
      title={texts.joints.title}
      class="joints"
      aside={<StreamNote device={device} streamer={streamer} blocked={blocked} />}
    >
      {description === null && <p class="quiet">{texts.joints.noDescription}</p>}
      {joints.length > 0 && (
        <>
          <div class="joint-head" aria-hidden="true">
            <span>{texts.joints.heading.joint}</span>
            <span>{texts.joints.heading.target}</span>
            <span>{texts.joints.heading.measured}</span>
          </div>
          {joints.map((joint, index) => (
            <JointRow
              key={joint.name}
              joint={joint}
              index={index}
              device={device}
              streamer={blocked === null ? streamer : null}
            />
          ))}
          <p class="quiet small">{texts.joints.keys}</p>
        </>
      )}
    </Card>
  );
}

/** Why the sliders cannot move the robot now; `null` when they can. */
function whyBlocked(device: DeviceStore, control: Control): string | null {
  if (control.streamer.value === null) return texts.joints.takeFirst;
  const mode = device.telemetry.value?.message.mode;
  if (device.stopped.value) return texts.joints.stopped;
  if (!device.live.value) return texts.joints.waiting;
  if (mode === "action") return texts.joints.busy;
  if (control.linkStatus.value?.state !== "up") return texts.control.noWay;
  return null;
}

interface StreamNoteProps {
  device: DeviceStore;
  streamer: SetpointStreamer | null;
  blocked: string | null;
}

function StreamNote({ device, streamer, blocked }: StreamNoteProps) {
  const [state, text] = streamText(device, streamer, blocked);
  const limited = state === "streaming" && limitsOf(device).length > 0;
  return (
    <span class={`quiet stream-${limited ? "limited" : state}`} data-testid="stream-state" data-state={state} role="status">
      {text}
    </span>
  );
}

function streamText(device: DeviceStore, streamer: SetpointStreamer | null, blocked: string | null): [string, string] {
  if (blocked !== null || streamer === null) return ["blocked", blocked ?? ""];
  const state = streamer.state.value;
  if (state === "waiting") return [state, texts.joints.waiting];
  if (state === "streaming") {
    const limited = limitsOf(device);
    return [state, limited.length > 0 ? texts.joints.limited(limited.join(", ")) : texts.joints.streaming];
  }
  const ended = streamer.ended.value;
  return [state, ended === null ? "" : texts.joints.ended[ended]];
}

/** What makes the motion other than asked for, as the robot names it. */
function limitsOf(device: DeviceStore): readonly string[] {
  return device.telemetry.value?.message.limited ?? [];
}

interface JointRowProps {
  joint: Joint;
  index: number;
  device: DeviceStore;
  /** There while this page may move the joint. */
  streamer: SetpointStreamer | null;
}

function JointRow({ joint, index, device, streamer }: JointRowProps) {
  const telemetry = device.telemetry.value?.message;
  const measuredRad = telemetry?.position_rad[index];
  const targetRad = streamer?.targets.value[joint.name] ?? telemetry?.commanded_rad[index];
  const measured = measuredRad === undefined ? undefined : degrees(measuredRad);
  const target = targetRad === undefined ? undefined : degrees(targetRad);
  const lower = degrees(joint.lower_rad);
  const upper = degrees(joint.upper_rad);
  const old = !device.live.value;
  const set = (deg: number): void => streamer?.setTarget(joint.name, radians(deg));
  return (
    <div class={`joint ${old ? "old" : ""}`} role="group" aria-label={joint.label}>
      <span class="joint-name">{joint.label}</span>
      <TargetField joint={joint} target={target} disabled={streamer === null} onSet={set} />
      <span
        class="measured"
        data-testid={`measured-${joint.name}`}
        data-value={measured?.toFixed(3) ?? ""}
        title={texts.joints.measured(joint.label)}
      >
        {measured === undefined ? texts.number.unknown : texts.number.degrees(measured)}
      </span>
      <div class="track">
        <span class="limit quiet" aria-hidden="true">
          {texts.number.wholeDegrees(lower)}
        </span>
        <span class="rail">
        <input
          type="range"
          data-testid={`slider-${joint.name}`}
          aria-label={texts.joints.slider(joint.label)}
          aria-valuetext={target === undefined ? texts.number.unknown : texts.number.degrees(target)}
          min={lower}
          max={upper}
          step="any"
          value={target ?? (lower + upper) / 2}
          disabled={streamer === null || target === undefined}
          onInput={(event) => set(event.currentTarget.valueAsNumber)}
          onKeyDown={(event) => {
            const step = stepOf(event);
            if (step === null) return;
            event.preventDefault();
            if (target !== undefined && step !== 0) set(target + step);
          }}
        />
        {measured !== undefined && (
          <span class="marker" aria-hidden="true" style={{ "--at": String((measured - lower) / (upper - lower)) }} />
        )}
        </span>
        <span class="limit quiet" aria-hidden="true">
          {texts.number.wholeDegrees(upper)}
        </span>
      </div>
    </div>
  );
}

/** Degrees that a key moves a slider; 0 for a key that must do nothing; `null` for keys that are not ours. */
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
      // One key must not send a joint across its whole range.
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

/** The target as a number. What is typed counts at Enter, and is forgotten when the field is left. */
function TargetField({ joint, target, disabled, onSet }: TargetFieldProps) {
  const [typed, setTyped] = useState<string | null>(null);
  const field = useRef<HTMLInputElement>(null);
  const shown = target === undefined ? "" : texts.number.oneDigit(target);
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
