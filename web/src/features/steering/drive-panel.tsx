import type { DeviceStore } from "../devices/model";
import { useState } from "preact/hooks";
import { degrees } from "../../shared/lib/angles";
import { DRIVE_KEYS } from "./model/keymap";
import type { BaseLimits } from "../../shared/mqtt/protocol.generated";
import { AT_REST, driveOf, sumOfPushes, type Push } from "./model/steerable-parts";
import type { SetpointStreamer } from "./model/setpoint-streamer";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { useGamepadInputs } from "./inputs/use-gamepad";
import { usePressedInputs } from "./inputs/use-pressed-inputs";
import { HoldButton } from "./inputs/hold-button";
import { useHeldKeys } from "./inputs/keyboard-help";
import type { PanelProps } from "./panel-props";
import { NumberWithUnit } from "../../shared/ui/number-with-unit";
import { VirtualStick } from "./inputs/virtual-stick";

const PERCENT = { min: 5, max: 100, step: 5, initial: 50 };

/** Drives the base while a stick, key or gamepad is held. */
export function DrivePanel({ device, streamer, active, pad }: PanelProps) {
  const limits = device.description.value?.base ?? { forward_m_s: 0, left_m_s: 0, turn_rad_s: 0 };
  const [percent, setPercent] = useState(PERCENT.initial);
  const inputs = usePressedInputs<Push>(streamer, (parts) => driveOf(sumOfPushes(parts), limits, percent / 100));
  useHeldKeys(active && streamer !== null, inputs, DRIVE_KEYS);
  useGamepadInputs(pad, inputs, ({ left, right }) => ({ forward: left[1], turn: -left[0], left: -right[0] }));
  const canMoveSideways = limits.left_m_s > 0;
  return (
    <div class="drive">
      <div class="drive-hands">
        {canMoveSideways && (
          <HoldButton
            inputs={inputs}
            name="left"
            part={{ ...AT_REST, left: 1 }}
            label={texts.steer.sideways.left}
            disabled={streamer === null}
          >
            ←
          </HoldButton>
        )}
        <VirtualStick inputs={inputs} disabled={streamer === null} />
        {canMoveSideways && (
          <HoldButton
            inputs={inputs}
            name="right"
            part={{ ...AT_REST, left: -1 }}
            label={texts.steer.sideways.right}
            disabled={streamer === null}
          >
            →
          </HoldButton>
        )}
      </div>
      <NumberWithUnit
        label={texts.steer.upTo}
        name="drive"
        range={PERCENT}
        value={percent}
        text={texts.steer.driveSpeed((limits.forward_m_s * percent) / 100, degrees((limits.turn_rad_s * percent) / 100))}
        onChange={setPercent}
      />
      <Velocities device={device} streamer={streamer} limits={limits} />
    </div>
  );
}

const PARTS = ["forward_m_s", "left_m_s", "turn_rad_s"] as const;

interface VelocitiesProps {
  device: DeviceStore;
  streamer: SetpointStreamer | null;
  limits: BaseLimits;
}

/** The commanded velocity of the base, and the measured one if available. */
function Velocities({ device, streamer, limits }: VelocitiesProps) {
  const stream = device.description.value?.streams.find(({ name }) => name === "odometry")?.name;
  const measured = stream === undefined ? null : device.measured(stream).value;
  const target = streamer?.velocity.value;
  const shown = PARTS.filter((part) => limits[part] > 0);
  const values = measured?.message.values ?? {};
  const hasMeasurements = shown.some((part) => typeof values[part] === "number");
  const text = (part: (typeof PARTS)[number], value: unknown): string =>
    typeof value === "number"
      ? part === "turn_rad_s"
        ? texts.steer.degreesPerSecond(Math.round(degrees(value)))
        : texts.steer.metresPerSecond(value)
      : format.unknown;
  return (
    <table class="velocities" data-testid="velocities" data-forward={String(values["forward_m_s"] ?? "")}>
      <thead>
        <tr>
          <td />
          <th scope="col">{texts.steer.target}</th>
          {hasMeasurements && <th scope="col">{texts.steer.measured}</th>}
        </tr>
      </thead>
      <tbody>
        {shown.map((part) => (
          <tr key={part}>
            <th scope="row">{texts.steer.part[part]}</th>
            <td>{text(part, target?.kind === "drive" ? target[part] : 0)}</td>
            {hasMeasurements && (
              <td class={stream !== undefined && device.late(stream) ? "old" : "measured"}>{text(part, values[part])}</td>
            )}
          </tr>
        ))}
      </tbody>
    </table>
  );
}
