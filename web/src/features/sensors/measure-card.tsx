import { unavailableReason } from "../devices";
import type { DeviceStore } from "../devices/model";
import { Age } from "../../shared/ui/age";
import { Card } from "../../shared/ui/card";
import { Choice } from "../../shared/ui/choice";
import { useState } from "preact/hooks";
import type { RoomDeviceAction } from "./model/room-device-action";
import { quantityOf } from "./model/quantities";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { shown } from "./readings-card";

const LEAST_HZ = 0.001;
const MOST_HZ = 50;
/** Maximum number of values per measurement here; the rest is in its own card. */
const MOST_SHOWN = 12;

type Time = keyof typeof texts.collect.times;

interface GatherProps {
  device: DeviceStore;
  roomAction: RoomDeviceAction;
}

/** Collects data at a chosen rate, or measures once. */
export function CollectDataCard({ device, roomAction }: GatherProps) {
  const own = Math.max(...(device.description.value?.streams ?? []).map(({ rate_hz: rate }) => rate), LEAST_HZ);
  const [rate, setRate] = useState(String(Math.min(MOST_HZ, Math.max(1, own * 2))));
  const [time, setTime] = useState<Time>("60");
  const action = device.state.value?.action ?? null;
  const running = action?.kind === "gather";
  const rateHz = Number(rate);
  const valid = rate.trim() !== "" && rateHz >= LEAST_HZ && rateHz <= MOST_HZ;
  const no = unavailableReason(device);
  const busy = roomAction.busy.value;

  const submit = (event: SubmitEvent): void => {
    event.preventDefault();
    if (running) void roomAction.stopGathering();
    else if (valid && no === "" && busy === null) void roomAction.gather([], rateHz, Number(time));
  };

  return (
    <Card title={texts.collect.title}>
      <p class="quiet small">{texts.collect.explain}</p>
      <form class="gather" onSubmit={submit}>
        <label>
          {texts.collect.rate}
          <input
            type="text"
            inputMode="decimal"
            value={rate}
            disabled={running}
            aria-invalid={!valid}
            data-testid="gather-rate"
            onInput={(event) => setRate(event.currentTarget.value)}
          />
        </label>
        <Choice
          label={texts.collect.time}
          value={time}
          onChange={setTime}
          options={Object.entries(texts.collect.times) as [Time, string][]}
        />
        <div class="row">
        <button
          type="submit"
          class="primary"
          data-testid="gather"
          aria-pressed={running}
          disabled={!running && (!valid || no !== "" || busy !== null)}
          title={no}
        >
          {running ? texts.collect.stop : texts.collect.start}
        </button>
        <button
          type="button"
          data-testid="shoot"
          disabled={no !== "" || busy !== null || action !== null}
          title={no}
          onClick={() => void roomAction.shoot()}
        >
          {texts.collect.once}
        </button>
        </div>
      </form>
      {!valid && <p class="field-error">{texts.collect.badRate}</p>}
      <div role="status" data-testid="gather-state" data-running={String(running)}>
        {running ? (
          <>
            {texts.collect.running(Math.round((action.progress ?? 0) * 100))}
            <progress value={action.progress ?? 0} max={1} />
          </>
        ) : (
          <span class="quiet">{action === null ? texts.collect.rest : texts.collect.busy}</span>
        )}
      </div>
      <Paces device={device} />
      {roomAction.why.value !== "" && <p class="notice bad">{roomAction.why.value}</p>}
      <Once device={device} roomAction={roomAction} />
    </Card>
  );
}

/** The actual rate of each stream. */
function Paces({ device }: { device: DeviceStore }) {
  const paces = (device.description.value?.streams ?? []).flatMap(({ name }) => {
    const everyMs = device.measured(name).value?.everyMs ?? null;
    return everyMs === null || everyMs <= 0 || device.late(name) ? [] : [texts.collect.pace(name, pace(1000 / everyMs))];
  });
  return paces.length === 0 ? null : <p class="quiet small">{paces.join(" · ")}</p>;
}

function pace(hz: number): string {
  return hz < 1 ? hz.toFixed(2) : format.oneDigit(hz);
}

function Once({ device, roomAction }: GatherProps) {
  const shot = roomAction.shot.value;
  const description = device.description.value;
  if (shot === null || description === null) return null;
  const rows = Object.entries(shot.streams).flatMap(([stream, values]) =>
    Object.entries(values).map(([field, value]) => ({ quantity: quantityOf(description, stream, field), value })),
  );
  return (
    <div data-testid="shot">
      <p class="quiet small">
        <Age at={shot.at} as={texts.collect.onceTaken} />
      </p>
      <dl class="figures">
        {rows.slice(0, MOST_SHOWN).map(({ quantity, value }) => (
          <div key={`${quantity.stream} ${quantity.field}`}>
            <dt>{quantity.label}</dt>
            <dd>
              {typeof value === "boolean"
                ? (common.booleanState[quantity.field] ?? common.yesNo)[value ? 0 : 1]
                : `${shown(quantity, value)} ${quantity.unit}`}
            </dd>
          </div>
        ))}
      </dl>
    </div>
  );
}
