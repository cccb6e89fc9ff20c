/** Readings of one stream: a number with its history, a state with its start time, or a table. */
import type { DeviceStore } from "../devices/model";
import { Age } from "../../shared/ui/age";
import { Card } from "../../shared/ui/card";
import { Choice } from "../../shared/ui/choice";
import { useMemo, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { toPageClock } from "../../shared/lib/clock";
import { digits, assess, quantityOf, type Quantity } from "./model/quantities";
import type { Recording } from "./model/stored-series";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { HistoryCard, useRecording } from "./history-card";
import "./sensors.css";

/** More values are shown as a table. */
const MAX_CARDS = 4;
/** The stream with the values of the controls. */
const SETTINGS = "settings";

type Span = keyof typeof texts.room.spans;
const SPAN_MS: Readonly<Record<Span, number>> = { "10min": 600_000, "1h": 3_600_000, "24h": 86_400_000 };

interface ReadingsProps {
  api: Api;
  device: DeviceStore;
  stream: string;
}

export function ReadingsCard({ api, device, stream }: ReadingsProps) {
  const values = device.measured(stream).value?.message.values ?? {};
  const description = device.description.value;
  const fields = Object.keys(values);
  const fieldNames = fields.join(" ");
  const quantities = useMemo(
    () => (description === null ? [] : withStreamLabel(fields.map((field) => quantityOf(description, stream, field)))),
    [description, stream, fieldNames],
  );
  if (fields.length === 0) {
    return (
      <Card title={capital(stream)}>
        <p class="quiet">{texts.room.noDataYet}</p>
      </Card>
    );
  }
  if (fields.length > MAX_CARDS) return <Table device={device} stream={stream} quantities={quantities} />;
  return (
    <>
      {quantities.map((quantity) => (
        <Reading key={quantity.field} api={api} device={device} quantity={quantity} />
      ))}
    </>
  );
}

/** A stream's only value has the stream's label. */
function withStreamLabel(quantities: Quantity[]): Quantity[] {
  const [only] = quantities;
  if (quantities.length !== 1 || only === undefined || only.limits === null || only.stream === SETTINGS) return quantities;
  return [{ ...only, label: only.limits.label }];
}

interface ReadingProps {
  api: Api;
  device: DeviceStore;
  quantity: Quantity;
}

function Reading({ api, device, quantity }: ReadingProps) {
  const [span, setSpan] = useState<Span>("10min");
  const newest = device.measured(quantity.stream).value;
  const value = newest?.message.values[quantity.field];
  const late = device.late(quantity.stream);
  const { recording, error, loads } = useRecording(api, device, quantity, SPAN_MS[span]);
  const binary = typeof value === "boolean";
  return (
    <Card
      title={quantity.label}
      class="reading"
      aside={
        <Choice
          label={texts.room.span}
          value={span}
          onChange={setSpan}
          options={Object.entries(texts.room.spans) as [Span, string][]}
        />
      }
    >
      <p class={`figure-now ${late ? "old" : ""}`} data-testid={`value-${quantity.field}`} data-value={String(value ?? "")}>
        {binary ? (
          <Status recording={recording} field={quantity.field} value={value} loads={loads} />
        ) : (
          typeof value === "number" && <Figure quantity={quantity} value={value} />
        )}
        {late && newest !== null && (
          <span class="chip reach-stale">
            <Age at={newest.receivedAt} as={texts.room.late} />
          </span>
        )}
      </p>
      <HistoryCard recording={recording} quantity={quantity} spanMs={SPAN_MS[span]} binary={binary} old={late} />
      {quantity.limits !== null && !binary && <Limits quantity={quantity} />}
      {error !== "" && <p class="quiet small">{texts.room.noHistory(error)}</p>}
    </Card>
  );
}

export function Figure({ quantity, value }: { quantity: Quantity; value: number }) {
  const assessment = assess(value, quantity.limits);
  return (
    <>
      <strong>{valueText(quantity, value)}</strong> <span class="unit">{quantity.unit}</span>
      {quantity.limits !== null && assessment !== "normal" && (
        <span class={`chip ${assessment === "outside" ? "bad" : "reach-stale"}`} title={quantity.limits.advice}>
          {texts.room.assessment[assessment]}
        </span>
      )}
    </>
  );
}

/** A boolean sensor, such as a door contact: its state and the start of that state. */
function Status({ recording, field, value, loads }: { recording: Recording; field: string; value: boolean; loads: number }) {
  const since = useMemo(() => recording.since(), [recording, value, loads]);
  const [yes, no] = common.booleanState[field] ?? common.yesNo;
  return (
    <>
      <span class={`lamp ${value ? "lit" : ""}`} aria-hidden="true" />
      <strong>{value ? yes : no}</strong>
      {since !== null && (
        <span class="quiet">
          {(since.atLeast ? texts.room.sinceLonger : texts.room.since)(format.recentTime(since.at))}
          {" · "}
          <Age at={toPageClock(since.at)} />
        </span>
      )}
    </>
  );
}

export function Limits({ quantity }: { quantity: Quantity }) {
  const { limits, unit, toDisplay: inUnit } = quantity;
  if (limits === null) return null;
  const text = (limit: number | null): string | null => (limit === null ? null : String(Number(inUnit(limit).toFixed(2))));
  const limitsText = texts.room.limits(text(limits.warning_low ?? limits.low), text(limits.warning_high ?? limits.high), unit);
  return limitsText === "" ? null : <p class="quiet small">{limitsText}</p>;
}

function Table({ device, stream, quantities }: { device: DeviceStore; stream: string; quantities: readonly Quantity[] }) {
  const newest = device.measured(stream).value;
  const late = device.late(stream);
  return (
    <Card
      title={capital(stream)}
      aside={
        late &&
        newest !== null && (
          <span class="chip reach-stale">
            <Age at={newest.receivedAt} as={texts.room.late} />
          </span>
        )
      }
    >
      <div class="scroll" tabIndex={0} role="region" aria-label={texts.room.values(stream)}>
        <table class={late ? "old" : ""}>
          <thead>
            <tr>
              <th scope="col">{texts.room.name}</th>
              <th scope="col">{texts.room.value}</th>
            </tr>
          </thead>
          <tbody>
            {quantities.map((quantity) => {
              const value = newest?.message.values[quantity.field];
              return (
                <tr key={quantity.field}>
                  <th scope="row">{quantity.label}</th>
                  <td>{value === undefined ? format.unknown : cell(quantity, value)}</td>
                </tr>
              );
            })}
          </tbody>
        </table>
      </div>
    </Card>
  );
}

function cell(quantity: Quantity, value: number | boolean): string {
  if (typeof value === "boolean") return common.yesNo[value ? 0 : 1];
  return `${valueText(quantity, value)} ${quantity.unit}`.trim();
}

/** Three significant digits; integers unchanged. */
export function valueText(quantity: Quantity, value: number): string {
  const converted = quantity.toDisplay(value);
  if (Number.isInteger(converted)) return String(converted);
  return converted.toFixed(digits(Math.max(Math.abs(converted), 0.01)));
}

function capital(text: string): string {
  return (text.charAt(0).toUpperCase() + text.slice(1)).replaceAll("_", " ");
}
