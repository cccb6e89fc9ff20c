import type { DeviceStore } from "../devices/model";
import { rollPitchYaw, unit } from "../twin/model";
import { Choice } from "../../shared/ui/choice";
import { useState } from "preact/hooks";
import { degrees, radians } from "../../shared/lib/angles";
import { JOG_KEYS } from "./model/keymap";
import { direction, jogOf, sumOf, type Direction } from "./model/steerable-parts";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { useGamepadInputs } from "./inputs/use-gamepad";
import { usePressedInputs } from "./inputs/use-pressed-inputs";
import { HoldButton } from "./inputs/hold-button";
import { useHeldKeys } from "./inputs/keyboard-help";
import type { PanelProps } from "./panel-props";
import { NumberWithUnit } from "../../shared/ui/number-with-unit";

/** Maximum jog speed [mm/s], from ISO 10218-1 for people near a robot; and rotation [°/s]. */
const LINEAR_MM_S = { min: 5, max: 250, step: 5, initial: 60 };
const ANGULAR_DEG_S = { min: 1, max: 60, step: 1, initial: 15 };

const AXES = ["x", "y", "z"] as const;
const TURNS = ["roll", "pitch", "yaw"] as const;
const SIGNS = [1, -1] as const;

type Axes = "base" | "tool";

/** Moves a frame along and about its axes while a button, key or stick is held. */
export function CartesianPanel({ device, streamer, active, pad }: PanelProps) {
  const frames = device.description.value?.frames ?? [];
  const [picked, setPicked] = useState<string | null>(null);
  const [axes, setAxes] = useState<Axes>("base");
  const [linear, setLinear] = useState(LINEAR_MM_S.initial);
  const [angular, setAngular] = useState(ANGULAR_DEG_S.initial);
  const frame = picked !== null && frames.includes(picked) ? picked : (frames.at(-1) ?? "");
  const speed = { linear_m_s: linear / 1000, angular_rad_s: radians(angular) };
  const inputs = usePressedInputs<Direction>(streamer, (parts) => jogOf(sumOf(parts), speed, frame, axes === "tool"));
  useHeldKeys(active && streamer !== null, inputs, JOG_KEYS);
  useGamepadInputs(pad, inputs, ({ left, right, lift, cross }): Direction => ({
    along: [left[1], -left[0], lift],
    about: [right[0], right[1], -cross[0]],
  }));

  return (
    <div class="jog">
      <div class="row jog-choices">
        <label>
          {texts.steer.frame}{" "}
          <select value={frame} data-testid="jog-frame" onChange={(event) => setPicked(event.currentTarget.value)}>
            {frames.map((name) => (
              <option key={name}>{name}</option>
            ))}
          </select>
        </label>
        <Choice
          label={texts.steer.axes}
          value={axes}
          onChange={setAxes}
          options={[
            ["base", texts.steer.inBase],
            ["tool", texts.steer.inTool],
          ]}
        />
      </div>
      <div class="pads">
        {([
          ["along", AXES, texts.steer.along],
          ["about", TURNS, texts.steer.about],
        ] as const).map(([kind, names, title]) => (
          <div key={kind} role="group" aria-label={title} class="pad-group">
            <h3>{title}</h3>
            {names.map((name, axis) => (
              <div key={name} class="pad-row">
                {SIGNS.map((sign) => (
                  <HoldButton
                    key={sign}
                    inputs={inputs}
                    name={`${name}${sign > 0 ? "+" : "-"}`}
                    part={direction(kind, axis as 0 | 1 | 2, sign)}
                    label={texts.steer.pad(name, sign)}
                    disabled={streamer === null}
                  >
                    {texts.steer.padShort(name, sign)}
                  </HoldButton>
                ))}
              </div>
            ))}
          </div>
        ))}
      </div>
      <NumberWithUnit
        label={texts.steer.linear}
        name="linear"
        range={LINEAR_MM_S}
        value={linear}
        text={texts.steer.millimetres(linear)}
        onChange={setLinear}
      />
      <NumberWithUnit
        label={texts.steer.angular}
        name="angular"
        range={ANGULAR_DEG_S}
        value={angular}
        text={texts.steer.degreesPerSecond(angular)}
        onChange={setAngular}
      />
      <LivePose device={device} frame={frame} />
    </div>
  );
}

/** The measured pose of the frame in the robot's base. */
function LivePose({ device, frame }: { device: DeviceStore; frame: string }) {
  const index = device.description.value?.frames.indexOf(frame) ?? -1;
  const pose = device.telemetry.value?.message.frames[index];
  const at = pose?.slice(0, 3);
  const rollPitchYawDeg = pose === undefined ? undefined : rollPitchYaw(unit([pose[3], pose[4], pose[5], pose[6]])).map(degrees);
  return (
    <dl
      class={`figures live-pose ${device.live.value ? "" : "old"}`}
      data-testid="live-pose"
      data-value={at?.map((part) => part.toFixed(4)).join(" ") ?? ""}
      aria-label={texts.steer.poseOf(frame)}
    >
      {AXES.map((name, axis) => (
        <div key={name}>
          <dt>{name}</dt>
          <dd>{at === undefined ? format.unknown : texts.steer.metres(at[axis] ?? NaN)}</dd>
        </div>
      ))}
      {TURNS.map((name, axis) => (
        <div key={name}>
          <dt>{name}</dt>
          <dd>{rollPitchYawDeg === undefined ? format.unknown : format.degrees(rollPitchYawDeg[axis] ?? NaN)}</dd>
        </div>
      ))}
    </dl>
  );
}
