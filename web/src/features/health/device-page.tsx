/** Health of one device: monitored fields with trends, and faults from the first report to the end. */
import type { DeviceStore } from "../devices/model";
import { valueText } from "../sensors";
import { type Quantity, quantityOf } from "../sensors/model";
import { Card } from "../../shared/ui/card";
import { Choice } from "../../shared/ui/choice";
import type { DeviceHealth, Fault, StoredStream, MonitoredField } from "../../shared/api/health";
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { healthNow, isLate, newestOf, openCount, compareFaults, reportedFaults, watchedQuantity, worstFirst } from "./model/health";
import { sentence } from "../../shared/api/http";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { FaultItem } from "./fault-item";
import { codes, HealthLabel, useReportedFaults } from "./health-chip";
import { usePolling } from "../../shared/hooks/use-polling";
import { Trend } from "./trend-chart";

const EVERY_MS = 5_000;
const PAST = 50;

interface FieldKey {
  stream: string;
  field: string;
}

export function DeviceHealthView({ api, device }: { api: Api; device: DeviceStore }) {
  const { value, error, refresh } = usePolling(() => api.health.of(device.id), EVERY_MS, [api, device]);
  const reported = reportedFaults(device);
  useReportedFaults(codes(reported), refresh);
  const past = usePastFaults(api, device, value?.faults.map(({ id }) => id).join(" ") ?? "");
  const [chosen, setChosen] = useState<FieldKey | null>(null);
  const trend = useRef<HTMLDivElement>(null);
  const fields = useMemo(() => worstFirst(value?.fields ?? []), [value]);
  const first = fields[0] ?? null;
  const selected = chosen ?? first;
  const show = (stream: string, field: string): void => {
    setChosen({ stream, field });
    trend.current?.scrollIntoView({ block: "nearest" });
    trend.current?.focus();
  };
  return (
    <div class="desk health-columns">
      <div class="column">
        <HealthSummary device={device} value={value} error={error} />
        <Faults api={api} device={device} open={value?.faults ?? null} past={past} again={refresh} show={show} />
      </div>
      <div class="column">
        <div ref={trend} tabIndex={-1} class="trend-panel">
          {selected === null ? (
            <Card title={texts.trend.title}>
              <p class="quiet">{value === null ? common.loading : texts.health.noMonitored}</p>
            </Card>
          ) : (
            <Chart api={api} device={device} selected={selected} fields={fields} faults={[...(value?.faults ?? []), ...past.items]} />
          )}
        </div>
        <Fields device={device} fields={fields} selected={selected} show={(stream, field) => setChosen({ stream, field })} />
        <OtherFields api={api} device={device} fields={fields} selected={selected} choose={setChosen} />
      </div>
    </div>
  );
}

function HealthSummary({ device, value, error }: { device: DeviceStore; value: DeviceHealth | null; error: string }) {
  const reported = reportedFaults(device);
  const count = openCount(value?.faults ?? null, reported);
  return (
    <div class="row health-summary">
      {value !== null && <HealthLabel health={healthNow(value.health, reported, device.reach.value)} />}
      <p role="status" data-testid="open-faults" data-count={count}>
        {value === null && error === "" ? common.loading : texts.health.open(count)}
      </p>
      <button type="button" class="plain no-print" onClick={() => print()}>
        {texts.health.print}
      </button>
      {error !== "" && <p class="notice bad">{texts.health.failed(error)}</p>}
    </div>
  );
}

interface PastFaults {
  items: readonly Fault[];
  more: boolean;
  error: string;
  loadOlder: () => void;
}

/** Past faults, reloaded when the open ones change. */
function usePastFaults(api: Api, device: DeviceStore, open: string): PastFaults {
  const [items, setItems] = useState<readonly Fault[]>([]);
  const [cursor, setCursor] = useState<string | null>(null);
  const [error, setError] = useState("");
  const generation = useRef(0);
  const load = (from: string | null): void => {
    const current = ++generation.current;
    api.health.clearedFaults(device.id, from, PAST).then(
      (page) => {
        if (current !== generation.current) return;
        setItems((previous) => (from === null ? page.items : [...previous, ...page.items]));
        setCursor(page.cursor);
        setError("");
      },
      (error: unknown) => current === generation.current && setError(sentence(error)),
    );
  };
  useEffect(() => {
    load(null);
    return () => void (generation.current += 1);
  }, [api, device, open]);
  return { items, more: cursor !== null, error, loadOlder: () => load(cursor) };
}

type FaultFilter = "open" | "past";

interface FaultsProps {
  api: Api;
  device: DeviceStore;
  open: readonly Fault[] | null;
  past: PastFaults;
  again: () => void;
  show: (stream: string, field: string) => void;
}

function Faults({ api, device, open, past, again, show }: FaultsProps) {
  const [filter, setFilter] = useState<FaultFilter>("open");
  const listed = filter === "open" ? compareFaults(open ?? [], reportedFaults(device)) : compareFaults(past.items, []).map((one) => ({ ...one, agreement: "same" as const }));
  return (
    <Card
      title={texts.health.faults}
      class="fault-card"
      aside={<Choice label={texts.health.whichFaults} value={filter} onChange={setFilter} options={Object.entries(texts.health.faultLists) as [FaultFilter, string][]} />}
    >
      {listed.length === 0 && <p class="quiet">{open === null ? common.loading : texts.health.noFaults[filter]}</p>}
      <ul class="fault-list" data-testid={`faults-${filter}`}>
        {listed.map((one) => (
          <FaultItem key={one.stored?.id ?? one.reported?.code} api={api} device={device} comparison={one} onChange={again} showTrend={show} />
        ))}
      </ul>
      {filter === "past" && past.error !== "" && <p class="notice bad">{texts.health.failed(past.error)}</p>}
      {filter === "past" && past.more && (
        <button type="button" onClick={past.loadOlder}>
          {texts.health.older}
        </button>
      )}
    </Card>
  );
}

interface ChartProps {
  api: Api;
  device: DeviceStore;
  selected: FieldKey;
  fields: readonly MonitoredField[];
  faults: readonly Fault[];
}

function Chart({ api, device, selected: { stream, field }, fields, faults }: ChartProps) {
  const description = device.description.value;
  const watched = fields.find((one) => one.stream === stream && one.field === field) ?? null;
  // A new object with the same limits must not rebuild the chart.
  const limits = watched === null ? "" : [watched.label, watched.unit, watched.low, watched.high, watched.warning_low, watched.warning_high].join(" ");
  const quantity = useMemo((): Quantity => {
    if (watched !== null) return watchedQuantity(watched, description);
    return quantityOf(description ?? { controls: [], diagnostics: [] }, stream, field);
  }, [description, stream, field, limits]);
  return <Trend key={`${stream}/${field}`} api={api} device={device} quantity={quantity} watched={watched} faults={faults} />;
}

interface FieldsProps {
  device: DeviceStore;
  fields: readonly MonitoredField[];
  selected: FieldKey | null;
  show: (stream: string, field: string) => void;
}

/** All monitored fields: current, usual and permitted values; a click shows the trend. */
function Fields({ device, fields, selected, show }: FieldsProps) {
  const description = device.description.value;
  if (fields.length === 0) return null;
  return (
    <Card title={texts.health.watched}>
      <div class="scroll" tabIndex={0} role="region" aria-label={texts.health.watched}>
        <table class="watched" data-testid="watched">
          <thead>
            <tr>
              {texts.health.columns.map((name) => (
                <th key={name} scope="col">
                  {name}
                </th>
              ))}
            </tr>
          </thead>
          <tbody>
            {fields.map((one) => (
              <Field
                key={`${one.stream}/${one.field}`}
                device={device}
                watched={one}
                quantity={watchedQuantity(one, description)}
                chosen={selected?.stream === one.stream && selected.field === one.field}
                show={show}
              />
            ))}
          </tbody>
        </table>
      </div>
    </Card>
  );
}

interface FieldProps {
  device: DeviceStore;
  watched: MonitoredField;
  quantity: Quantity;
  chosen: boolean;
  show: (stream: string, field: string) => void;
}

function Field({ device, watched, quantity, chosen, show }: FieldProps) {
  const { stream, field, findings, advice } = watched;
  const newest = newestOf(device, stream, field);
  const value = newest === null ? watched.value : Number(newest.value);
  const old = newest === null || isLate(device, stream);
  const text = (one: number): string => `${valueText(quantity, one)} ${quantity.unit}`.trim();
  const span = (low: number | null, high: number | null): string => texts.health.span(low === null ? null : text(low), high === null ? null : text(high));
  return (
    <tr data-testid="watched-row" data-field={`${stream}.${field}`}>
      <th scope="row">
        <button type="button" class="plain" aria-pressed={chosen} onClick={() => show(stream, field)}>
          {quantity.label}
        </button>
        {findings.length > 0 && (
          <p class="field-findings">
            {findings.map((kind) => (
              <span key={kind} class="chip reach-stale">
                {texts.health.kind[kind] ?? kind}
              </span>
            ))}{" "}
            {advice}
          </p>
        )}
      </th>
      <td class={old ? "old" : ""} title={old ? texts.health.storedAt(format.dateTime(watched.updated_at)) : undefined}>
        {text(value)}
      </td>
      <td>{watched.usual_low === null ? format.unknown : span(watched.usual_low, watched.usual_high)}</td>
      <td>{span(watched.warning_low ?? watched.low, watched.warning_high ?? watched.high)}</td>
    </tr>
  );
}

interface OtherFieldsProps {
  api: Api;
  device: DeviceStore;
  fields: readonly MonitoredField[];
  selected: FieldKey | null;
  choose: (chosen: FieldKey) => void;
}

/** Fields that are stored but not monitored. */
function OtherFields({ api, device, fields, selected, choose }: OtherFieldsProps) {
  const [streams, setStreams] = useState<readonly StoredStream[]>([]);
  useEffect(() => {
    let mounted = true;
    // Without this list the monitored fields are still shown.
    api.health.streams(device.id).then((items) => mounted && setStreams(items), () => undefined);
    return () => void (mounted = false);
  }, [api, device]);
  const description = device.description.value ?? { controls: [], diagnostics: [] };
  const watched = new Set(fields.map(({ stream, field }) => `${stream}/${field}`));
  const others = streams
    .map(({ name, fields: all }) => [name, all.filter((field) => !watched.has(`${name}/${field}`))] as const)
    .filter(([, unmonitored]) => unmonitored.length > 0);
  if (others.length === 0) return null;
  const value = selected === null || watched.has(`${selected.stream}/${selected.field}`) ? "" : `${selected.stream}/${selected.field}`;
  return (
    <Card title={texts.health.others} class="no-print">
      <label class="field">
        {texts.health.selectOther}
        <select
          value={value}
          data-testid="other-fields"
          onChange={(event) => {
            const [stream, ...field] = event.currentTarget.value.split("/");
            if (stream !== undefined && stream !== "") choose({ stream, field: field.join("/") });
          }}
        >
          <option value="">{texts.health.noOther}</option>
          {others.map(([stream, left]) => (
            <optgroup key={stream} label={stream.replaceAll("_", " ")}>
              {left.map((field) => (
                <option key={field} value={`${stream}/${field}`}>
                  {quantityOf(description, stream, field).label}
                </option>
              ))}
            </optgroup>
          ))}
        </select>
      </label>
    </Card>
  );
}
