import { DevicePageFrame } from "../control";
/** Latency of all devices, or of one, which can be probed. */
import type { Account } from "../../shared/api/types";
import type { DeviceSession } from "../control/model";
import type { DeviceStore, Fleet } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { Choice } from "../../shared/ui/choice";
import { PATHS, type Path, type StoredLatency, TRANSPORTS, type Transport } from "../../shared/api/latency";
import { useMemo, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { serverNow } from "../../shared/lib/clock";
import { LatencyProbe } from "./model/probe";
import { publishedFor, SOURCES, type Published } from "./model/published-figures";
import { csv, figuresOf, lineKey, linesOf, type Line } from "./model/latency-stats";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { ProbePanel } from "./probe-panel";
import { usePolling } from "../../shared/hooks/use-polling";
import { LatencyPlots, type Axis, type Scale } from "./plots";
import "./latency.css";

const EVERY_MS = 10_000;
const CONCURRENT_READS = 4;
const HOUR_MS = 3_600_000;

type Span = keyof typeof texts.spans;
const SPAN_MS: Readonly<Record<Span, number>> = { hour: HOUR_MS, day: 24 * HOUR_MS, week: 7 * 24 * HOUR_MS, month: 30 * 24 * HOUR_MS };

interface LatencyPageProps {
  api: Api;
  fleet: Fleet;
  account: Account;
  /** The device's id, or empty. */
  device: string;
}

export function LatencyPage({ device, ...rest }: LatencyPageProps) {
  const devices = rest.fleet.devices.value;
  if (device !== "") {
    return (
      <DevicePageFrame {...rest} id={device} page="latency">
        {(session) => <DeviceLatency api={rest.api} fleet={rest.fleet} session={session} />}
      </DevicePageFrame>
    );
  }
  return (
    <main class="page monitoring latency-page" id="content">
      <h1>{texts.title}</h1>
      <p class="quiet">{texts.explained}</p>
      {devices === null ? <p class="quiet">{common.loading}</p> : <LatencyView api={rest.api} devices={[...devices.values()]} unsaved={NONE} />}
    </main>
  );
}

const NONE: readonly Line[] = [];

function DeviceLatency({ api, fleet, session }: { api: Api; fleet: Fleet; session: DeviceSession }) {
  const { device, control } = session;
  const probe = useMemo(() => new LatencyProbe(api, fleet.link, device, () => control.epoch), [api, fleet, device, control]);
  return (
    <div class="latency-page">
      <p class="quiet">{texts.explained}</p>
      <ProbePanel device={device} probe={probe} />
      <LatencyView api={api} devices={[device]} unsaved={probe.lines} />
    </div>
  );
}

interface Filter {
  device: string | null;
  transport: Transport | null;
  /** `undefined`: no choice yet. */
  path: Path | null | undefined;
  span: Span;
}

function LatencyView({ api, devices, unsaved }: { api: Api; devices: readonly DeviceStore[]; unsaved: readonly Line[] }) {
  const [filter, setFilter] = useState<Filter>({ device: null, transport: null, path: undefined, span: "day" });
  const [axis, setAxis] = useState<Axis>("order");
  const [scale, setScale] = useState<Scale>("log");
  const sinceMs = serverNow() - SPAN_MS[filter.span];
  const ids = devices.map(({ id }) => id);
  const { value, error } = usePolling(
    () => readAll(api, ids, serverNow() - SPAN_MS[filter.span]),
    EVERY_MS,
    [api, ids.join(" "), filter.span, unsaved.length],
  );
  const all = linesOf(value ?? new Map<string, StoredLatency[]>(), unsaved, { device: filter.device, transport: filter.transport, path: null, sinceMs });
  const path = filter.path === undefined ? mostSampledPath(all) : filter.path;
  const lines = path === null ? all : all.filter((line) => line.path === path);
  const published = publishedFor(path);
  const label = (id: string): string => devices.find((device) => device.id === id)?.info.value.label ?? id;
  const name = (line: Line): string =>
    texts.line(label(line.device), texts.transport[line.transport], path === null ? texts.path[line.path] : null);
  const count = lines.reduce((sum, { samples }) => sum + samples.length, 0);
  return (
    <>
      <fieldset class="card latency-filters">
        <legend class="visually-hidden">{texts.filters}</legend>
        {devices.length > 1 && (
          <Pick
            id="latency-device"
            label={texts.device}
            all={texts.allDevices}
            value={filter.device}
            options={devices.map((device) => [device.id, device.info.value.label])}
            onChange={(device) => setFilter({ ...filter, device })}
          />
        )}
        <Pick
          id="latency-path"
          label={texts.stage}
          all={texts.allStages}
          value={path}
          options={PATHS.map((one) => [one, texts.path[one]])}
          onChange={(chosen) => setFilter({ ...filter, path: chosen })}
        />
        <Pick
          id="latency-transport"
          label={texts.transportFilter}
          all={texts.allTransports}
          value={filter.transport}
          options={TRANSPORTS.map((one) => [one, texts.transport[one]])}
          onChange={(transport) => setFilter({ ...filter, transport })}
        />
        <Choice label={texts.span} value={filter.span} onChange={(span) => setFilter({ ...filter, span })} options={Object.entries(texts.spans) as [Span, string][]} />
        <Choice label={texts.axis} value={axis} onChange={setAxis} options={Object.entries(texts.axes) as [Axis, string][]} />
        <Choice label={texts.scale} value={scale} onChange={setScale} options={Object.entries(texts.scales) as [Scale, string][]} />
      </fieldset>
      {error !== "" && <p class="notice bad">{texts.failed(error)}</p>}
      {value === null && error === "" && <p class="quiet">{common.loading}</p>}
      {value !== null && count === 0 && (
        <p class="notice" data-testid="no-latency">
          {texts.none} {texts.collection}
        </p>
      )}
      <LatencyPlots lines={lines} name={name} published={published} axis={axis} scale={scale} />
      <FiguresCard lines={lines} name={name} save={() => download(csv(lines, label))} />
      <PublishedCard published={published} />
    </>
  );
}

/** The path with the most samples; `null`, for all, without any. */
function mostSampledPath(lines: readonly Line[]): Path | null {
  const counts = PATHS.map((path) => [path, lines.filter((line) => line.path === path).reduce((sum, { samples }) => sum + samples.length, 0)] as const);
  const [path, most] = counts.reduce((best, one) => (one[1] > best[1] ? one : best), ["command-started", 0]);
  return most === 0 ? null : path;
}

async function readAll(api: Api, ids: readonly string[], fromMs: number): Promise<Map<string, StoredLatency[]>> {
  const byDevice = new Map<string, StoredLatency[]>();
  for (let first = 0; first < ids.length; first += CONCURRENT_READS) {
    const part = ids.slice(first, first + CONCURRENT_READS);
    const read = await Promise.all(part.map((id) => api.latency.of(id, fromMs)));
    part.forEach((id, index) => byDevice.set(id, read[index] ?? []));
  }
  return byDevice;
}

interface PickProps<T extends string> {
  id: string;
  label: string;
  /** The label for no filter. */
  all: string;
  value: T | null;
  options: readonly (readonly [T, string])[];
  onChange: (value: T | null) => void;
}

function Pick<T extends string>({ id, label, all, value, options, onChange }: PickProps<T>) {
  return (
    <div class="field">
      <label for={id}>{label}</label>
      <select
        id={id}
        data-testid={id}
        value={value ?? ""}
        onChange={(event) => onChange(options.find(([one]) => one === event.currentTarget.value)?.[0] ?? null)}
      >
        <option value="">{all}</option>
        {options.map(([one, text]) => (
          <option key={one} value={one}>
            {text}
          </option>
        ))}
      </select>
    </div>
  );
}

interface FiguresCardProps {
  lines: readonly Line[];
  name: (line: Line) => string;
  save: () => void;
}

function FiguresCard({ lines, name, save: press }: FiguresCardProps) {
  const ms = format.milliseconds;
  if (lines.length === 0) return null;
  return (
    <Card
      title={texts.figures}
      aside={
        <button type="button" data-testid="latency-csv" onClick={press}>
          {texts.csv}
        </button>
      }
    >
      <div class="scroll" tabIndex={0} role="region" aria-label={texts.figures}>
        <table data-testid="latency-figures">
          <thead>
            <tr>
              {texts.columns.map((column) => (
                <th key={column} scope="col">
                  {column}
                </th>
              ))}
            </tr>
          </thead>
          <tbody>
            {lines.map((line, index) => {
              const figures = figuresOf(line.samples);
              return (
                <tr key={lineKey(line)} data-testid="latency-line" data-count={figures.count} data-path={line.path} data-transport={line.transport}>
                  <th scope="row">
                    <span class={`key-line series-${(index % 8) + 1}`} aria-hidden="true" /> {name(line)}
                  </th>
                  <td title={line.stored > figures.count ? texts.more(line.stored) : undefined}>{figures.count}</td>
                  {[figures.medianMs, figures.meanMs, figures.p95Ms, figures.p99Ms, figures.maxMs].map((value, at) => (
                    <td key={at}>{ms(value)}</td>
                  ))}
                </tr>
              );
            })}
          </tbody>
        </table>
      </div>
    </Card>
  );
}

/** Published figures for this path, with their sources. */
function PublishedCard({ published }: { published: readonly Published[] }) {
  const sources = [...new Set(published.map(({ source }) => source))];
  return (
    <Card title={texts.publishedTitle}>
      {published.length === 0 && <p class="quiet">{texts.publishedNone}</p>}
      <ul class="published">
        {published.map(({ id, ms, source }) => (
          <li key={id} data-testid="published" data-ms={ms}>
            <strong>{`${ms} ${texts.milliseconds}`}</strong> {texts.source(texts.published[id] ?? id, SOURCES[source].short)}
          </li>
        ))}
      </ul>
      {sources.map((source) => (
        <p key={source} class="quiet small">
          {SOURCES[source].citation}
        </p>
      ))}
    </Card>
  );
}

function download(content: string): void {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([content], { type: "text/csv" }));
  link.download = texts.csvName;
  link.click();
  // The browser keeps its own reference after the click.
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}
