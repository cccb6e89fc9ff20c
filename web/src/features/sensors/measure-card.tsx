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
import { valueText } from "./readings-card";

const MIN_HZ = 0.001;
const MAX_HZ = 50;
/** Maximum number of values per measurement here; the rest is in its own card. */
const MAX_SHOWN = 12;

type DurationOption = keyof typeof texts.collect.times;

interface CollectDataProps {
  device: DeviceStore;
  roomAction: RoomDeviceAction;
}

/** Collects data at a chosen rate, or measures once. */
export function CollectDataCard({ device, roomAction }: CollectDataProps) {
  const defaultRate = Math.max(...(device.description.value?.streams ?? []).map(({ rate_hz: rate }) => rate), MIN_HZ);
  const [rate, setRate] = useState(String(Math.min(MAX_HZ, Math.max(1, defaultRate * 2))));
  const [duration, setDuration] = useState<DurationOption>("60");
  const action = device.state.value?.action ?? null;
  const running = action?.kind === "gather";
  const rateHz = Number(rate);
  const valid = rate.trim() !== "" && rateHz >= MIN_HZ && rateHz <= MAX_HZ;
  const unavailable = unavailableReason(device);
  const busy = roomAction.busy.value;

  const submit = (event: SubmitEvent): void => {
    event.preventDefault();
    if (running) void roomAction.cancelCollection();
    else if (valid && unavailable === "" && busy === null) void roomAction.collect([], rateHz, Number(duration));
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
          label={texts.collect.duration}
          value={duration}
          onChange={setDuration}
          options={Object.entries(texts.collect.times) as [DurationOption, string][]}
        />
        <div class="row">
        <button
          type="submit"
          class="primary"
          data-testid="gather"
          aria-pressed={running}
          disabled={!running && (!valid || unavailable !== "" || busy !== null)}
          title={unavailable}
        >
          {running ? texts.collect.stop : texts.collect.start}
        </button>
        <button
          type="button"
          data-testid="shoot"
          disabled={unavailable !== "" || busy !== null || action !== null}
          title={unavailable}
          onClick={() => void roomAction.measureOnce()}
        >
          {texts.collect.measureOnce}
        </button>
        </div>
      </form>
      {!valid && <p class="field-error">{texts.collect.invalidRate}</p>}
      <div role="status" data-testid="gather-state" data-running={String(running)}>
        {running ? (
          <>
            {texts.collect.running(Math.round((action.progress ?? 0) * 100))}
            <progress value={action.progress ?? 0} max={1} />
          </>
        ) : (
          <span class="quiet">{action === null ? texts.collect.idle : texts.collect.busy}</span>
        )}
      </div>
      <StreamRates device={device} />
      {roomAction.error.value !== "" && <p class="notice bad">{roomAction.error.value}</p>}
      <MeasurementList device={device} roomAction={roomAction} />
    </Card>
  );
}

/** The actual rate of each stream. */
function StreamRates({ device }: { device: DeviceStore }) {
  const rates = (device.description.value?.streams ?? []).flatMap(({ name }) => {
    const everyMs = device.measured(name).value?.everyMs ?? null;
    return everyMs === null || everyMs <= 0 || device.late(name) ? [] : [texts.collect.rateText(name, rateText(1000 / everyMs))];
  });
  return rates.length === 0 ? null : <p class="quiet small">{rates.join(" · ")}</p>;
}

function rateText(hz: number): string {
  return hz < 1 ? hz.toFixed(2) : format.oneDigit(hz);
}

function MeasurementList({ device, roomAction }: CollectDataProps) {
  const shot = roomAction.measurement.value;
  const description = device.description.value;
  if (shot === null || description === null) return null;
  const rows = Object.entries(shot.streams).flatMap(([stream, values]) =>
    Object.entries(values).map(([field, value]) => ({ quantity: quantityOf(description, stream, field), value })),
  );
  return (
    <div data-testid="shot">
      <p class="quiet small">
        <Age at={shot.at} as={texts.collect.measuredOnce} />
      </p>
      <dl class="figures">
        {rows.slice(0, MAX_SHOWN).map(({ quantity, value }) => (
          <div key={`${quantity.stream} ${quantity.field}`}>
            <dt>{quantity.label}</dt>
            <dd>
              {typeof value === "boolean"
                ? (common.booleanState[quantity.field] ?? common.yesNo)[value ? 0 : 1]
                : `${valueText(quantity, value)} ${quantity.unit}`}
            </dd>
          </div>
        ))}
      </dl>
    </div>
  );
}
