/** One measured field over hours to weeks: the stored series with minimum and maximum, continued live. */
import type { DeviceStore } from "../devices/model";
import { Figure, HistoryCard, Limits, valueText, useRecording } from "../sensors";
import type { Quantity, Recording } from "../sensors/model";
import { Card } from "../../shared/ui/card";
import { Choice } from "../../shared/ui/choice";
import type { Fault, MonitoredField } from "../../shared/api/health";
import { useMemo, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { serverNow } from "../../shared/lib/clock";
import { isLate, newestOf } from "./model/health";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

type Span = keyof typeof texts.trend.spans;
const HOUR_MS = 3_600_000;
const SPAN_MS: Readonly<Record<Span, number>> = { "10min": HOUR_MS / 6, hour: HOUR_MS, day: 24 * HOUR_MS, week: 7 * 24 * HOUR_MS, month: 30 * 24 * HOUR_MS };
const ROWS = 200;

interface TrendProps {
  api: Api;
  device: DeviceStore;
  quantity: Quantity;
  /** `null`: not monitored. */
  watched: MonitoredField | null;
  /** All open and past faults of the device. */
  faults: readonly Fault[];
}

export function Trend({ api, device, quantity, watched, faults }: TrendProps) {
  const [span, setSpan] = useState<Span>("hour");
  const [view, setView] = useState<"chart" | "table">("chart");
  const spanMs = SPAN_MS[span];
  const { recording, error } = useRecording(api, device, quantity, spanMs);
  const newest = newestOf(device, quantity.stream, quantity.field);
  const late = isLate(device, quantity.stream);
  const low = watched?.usual_low ?? null;
  const high = watched?.usual_high ?? null;
  const fieldFaults = faults.filter(({ stream, field }) => stream === quantity.stream && field === quantity.field);
  const since = serverNow() - spanMs;
  const inSpan = fieldFaults.filter(({ cleared_at: end }) => end === null || Date.parse(end) >= since);
  const marks = {
    usual: low === null || high === null ? null : ([quantity.toDisplay(low), quantity.toDisplay(high)] as const),
    faults: inSpan.map(({ raised_at, cleared_at, severity }) => ({
      from: Date.parse(raised_at) / 1000,
      to: cleared_at === null ? null : Date.parse(cleared_at) / 1000,
      severity,
    })),
  };
  return (
    <Card
      title={quantity.label}
      class="trend"
      aside={<Choice label={texts.trend.span} value={span} onChange={setSpan} options={Object.entries(texts.trend.spans) as [Span, string][]} />}
    >
      <div class="row">
        <p class={`figure-now ${late ? "old" : ""}`} data-testid="trend-now" data-value={newest === null ? "" : Number(newest.value)}>
          {newest === null ? (
            <span class="quiet small">{texts.trend.noData}</span>
          ) : typeof newest.value === "boolean" ? (
            <strong>{common.yesNo[newest.value ? 0 : 1]}</strong>
          ) : (
            <Figure quantity={quantity} value={newest.value} />
          )}
        </p>
        <Choice label={texts.trend.view} value={view} onChange={setView} options={Object.entries(texts.trend.views) as ["chart" | "table", string][]} />
      </div>
      {view === "chart" ? (
        <HistoryCard recording={recording} quantity={quantity} spanMs={spanMs} binary={false} old={late} marks={marks} />
      ) : (
        <Rows recording={recording} quantity={quantity} spanMs={spanMs} />
      )}
      {quantity.limits !== null && <Limits quantity={quantity} />}
      {watched !== null && <p class="quiet small">{usual(watched, quantity)}</p>}
      {inSpan.length > 0 && (
        <ul class="trend-faults" aria-label={texts.trend.faults}>
          {inSpan.map((fault) => (
            <li key={fault.id} class={fault.severity} data-testid="trend-fault" data-code={fault.code}>
              {texts.trend.fault(
                texts.health.kind[fault.kind] ?? fault.kind,
                format.recentTime(Date.parse(fault.raised_at)),
                fault.cleared_at === null ? null : format.recentTime(Date.parse(fault.cleared_at)),
              )}
            </li>
          ))}
        </ul>
      )}
      {error !== "" && <p class="quiet small">{texts.trend.noHistory(error)}</p>}
    </Card>
  );
}

/** A time in seconds below two minutes. */
function timeText(s: number): string {
  return s < 120 ? `${Math.round(s)} s` : format.duration(s);
}

/** The learned range and trend as text. */
function usual({ usual_low: low, usual_high: high, slope_per_s: slope, limit_earliest_s: earliestS, limit_latest_s: latestS }: MonitoredField, quantity: Quantity): string {
  const text = (value: number): string => `${valueText(quantity, value)} ${quantity.unit}`.trim();
  const sentences = [low === null || high === null ? texts.trend.learning : texts.trend.usual(text(low), text(high))];
  const perMinute = slope === null ? 0 : (quantity.toDisplay(slope) - quantity.toDisplay(0)) * 60;
  if (Math.abs(perMinute) >= 0.0005) sentences.push(texts.trend.slope(perMinute > 0, `${Math.abs(perMinute).toPrecision(2)} ${quantity.unit}`));
  if (earliestS !== null && latestS !== null) sentences.push(texts.trend.limitBetween(timeText(earliestS), timeText(latestS)));
  return sentences.join(" ");
}

/** The values as a table, newest first. */
function Rows({ recording, quantity, spanMs }: { recording: Recording; quantity: Quantity; spanMs: number }) {
  const samples = useMemo(() => recording.samples(serverNow() - spanMs).reverse(), [recording, spanMs, Math.floor(serverNow() / 2000)]);
  return (
    <>
      <p class="quiet small" role="status">
        {texts.trend.rows(Math.min(ROWS, samples.length), samples.length)}
      </p>
      <div class="scroll rows" tabIndex={0} role="region" aria-label={texts.trend.values(quantity.label)}>
        <table data-testid="trend-table">
          <thead>
            <tr>
              {texts.trend.columns.map((name) => (
                <th key={name} scope="col">
                  {name}
                </th>
              ))}
            </tr>
          </thead>
          <tbody>
            {samples.slice(0, ROWS).map((one) => (
              <tr key={one.at}>
                <th scope="row">{format.recentTime(one.at)}</th>
                {[one.mean, one.low, one.high].map((value, index) => (
                  <td key={index}>{`${valueText(quantity, value)} ${quantity.unit}`}</td>
                ))}
              </tr>
            ))}
          </tbody>
        </table>
      </div>
    </>
  );
}
