import { unavailableReason } from "../devices";
import type { DeviceStore } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { useState } from "preact/hooks";
import { clamp } from "../../shared/lib/angles";
import type { RoomDeviceAction } from "./model/room-device-action";
import { quantityOf, type Quantity } from "./model/quantities";
import type { Control } from "../../shared/mqtt/protocol.generated";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

const STREAM = "settings";
const STEPS = 100;

interface SettingsProps {
  device: DeviceStore;
  roomAction: RoomDeviceAction;
}

/** Settings of a device within the limits of its description, with the current values. */
export function SettingsCard({ device, roomAction }: SettingsProps) {
  const description = device.description.value;
  const unavailable = unavailableReason(device);
  if (description === null) return null;
  return (
    <Card title={texts.settings.title} aside={unavailable !== "" && <span class="quiet">{unavailable}</span>}>
      {description.controls.map((control) => (
        <Setting
          key={control.name}
          device={device}
          roomAction={roomAction}
          control={control}
          text={textOf(control, quantityOf(description, STREAM, control.name))}
          disabled={unavailable !== ""}
        />
      ))}
    </Card>
  );
}

/** A control's value: shares in per cent, angles in degrees, with the digits of a step. */
function textOf({ lower, upper }: Control, { unit, toDisplay }: Quantity): (value: number) => string {
  const spread = toDisplay(upper) - toDisplay(lower);
  const places = spread > 50 ? 0 : spread > 5 ? 1 : 2;
  // No negative zero.
  return (value) => `${(Number(toDisplay(value).toFixed(places)) + 0).toFixed(places)} ${unit}`.trim();
}

interface SettingProps extends SettingsProps {
  control: Control;
  text: (value: number) => string;
  disabled: boolean;
}

function Setting({ device, roomAction, control, text, disabled }: SettingProps) {
  /** While the slider is dragged. */
  const [dragged, setDragged] = useState<number | null>(null);
  const measured = device.measured(STREAM).value?.message.values[control.name];
  const late = device.late(STREAM);
  const setting = roomAction.settings.value.get(control.name);
  const now = typeof measured === "number" ? measured : null;
  const target = dragged ?? setting?.requested ?? now ?? control.lower;
  const send = (value: number): void => {
    setDragged(null);
    void roomAction.set(control.name, clamp(value, control.lower, control.upper));
  };
  const ends = texts.settings.ends[control.name];
  const share = now === null ? null : (now - control.lower) / (control.upper - control.lower);
  return (
    <div class="setting">
      <div class="setting-head">
        <span class="joint-name">{control.label}</span>
        <span class={`measured ${late ? "old" : ""}`} data-testid={`now-${control.name}`} data-value={now ?? ""}>
          {texts.settings.now} {now === null ? format.unknown : text(now)}
        </span>
      </div>
      <div class="track">
        <span class="limit quiet">{text(control.lower)}</span>
        <div class="rail">
          <input
            type="range"
            min={control.lower}
            max={control.upper}
            step={(control.upper - control.lower) / STEPS}
            value={target}
            disabled={disabled}
            aria-label={texts.settings.slider(control.label)}
            aria-valuetext={text(target)}
            data-testid={`set-${control.name}`}
            onInput={(event) => setDragged(event.currentTarget.valueAsNumber)}
            onChange={(event) => send(event.currentTarget.valueAsNumber)}
          />
          {share !== null && <span class={`marker ${late ? "old" : ""}`} aria-hidden="true" style={{ "--at": String(clamp(share, 0, 1)) }} />}
        </div>
        <span class="limit quiet">{text(control.upper)}</span>
      </div>
      <div class="row setting-foot">
        {ends !== undefined &&
          [control.lower, control.upper].map((value, index) => (
            <button
              key={value}
              type="button"
              disabled={disabled}
              aria-pressed={setting !== undefined ? setting.requested === value : now === value}
              data-testid={`${control.name}-${index === 0 ? "least" : "most"}`}
              onClick={() => send(value)}
            >
              {ends[index === 0 ? 0 : 1]}
            </button>
          ))}
        <span class="small" role="status" data-testid={`applied-${control.name}`} data-value={setting?.applied ?? ""}>
          {dragged !== null ? (
            text(dragged)
          ) : setting === undefined ? (
            ""
          ) : setting.error !== "" ? (
            <span class="stream-limited">{texts.settings.refused(setting.error)}</span>
          ) : setting.applied === null ? (
            texts.settings.applying
          ) : (
            texts.settings.applied(text(setting.applied))
          )}
        </span>
      </div>
    </div>
  );
}
