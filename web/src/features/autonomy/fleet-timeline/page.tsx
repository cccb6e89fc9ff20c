/** Timeline of all robots: who controlled which one when, with Stops, faults and changes of control. */
import { useState } from "preact/hooks";
import type { Api } from "../../../shared/api/client";
import { usePolling } from "../../../shared/hooks/use-polling";
import { common } from "../../../shared/i18n/common";
import { serverNow } from "../../../shared/lib/clock";
import { Card } from "../../../shared/ui/card";
import { Choice } from "../../../shared/ui/choice";
import { type Fleet, isRoomDevice } from "../../devices/model";

import { readRow, type Row, TIME_RANGES, type TimeRange } from "../model/fleet-timeline";
import { TimelineChart } from "./chart";
import { TimelineTable } from "./table";
import { texts } from "./texts";
import "./timeline.css";

const EVERY_MS = 15_000;

/** A robot's row with its name. */
export interface NamedRow extends Row {
  label: string;
}

export function FleetTimelinePage({ api, fleet }: { api: Api; fleet: Fleet }) {
  const [range, setRange] = useState<TimeRange>("hour");
  /** End of the shown time [ms since 1970]; null: now. */
  const [endMs, setEndMs] = useState<number | null>(null);
  const [view, setView] = useState<"chart" | "table">("chart");
  const robots = [...(fleet.devices.value?.values() ?? [])].filter(({ info }) => !isRoomDevice(info.value));
  const { lengthMs } = TIME_RANGES[range];
  const ids = robots.map(({ id }) => id).join();
  const { value } = usePolling(
    async () => {
      const nowMs = serverNow();
      const toMs = endMs ?? nowMs;
      const rows = await Promise.all(robots.map(({ id }) => readRow(api, id, toMs - lengthMs, toMs, nowMs)));
      return { fromMs: toMs - lengthMs, toMs, rows };
    },
    EVERY_MS,
    [api, ids, lengthMs, endMs],
  );
  const move = (steps: number): void => {
    const movedMs = (endMs ?? serverNow()) + (steps * lengthMs) / 2;
    setEndMs(movedMs >= serverNow() ? null : movedMs);
  };
  const label = (id: string): string => fleet.devices.value?.get(id)?.info.value.label ?? id;
  const rows = value?.rows.map((row): NamedRow => ({ ...row, label: label(row.device) })).sort((one, other) => one.label.localeCompare(other.label));
  const incomplete = rows?.filter(({ complete }) => !complete).map((row) => row.label) ?? [];
  return (
    <main class="page fleet-timeline" id="content">
      <h1>{texts.title}</h1>
      <p class="quiet">{texts.explained}</p>
      <div class="timeline-controls">
        <Choice label={texts.range} value={range} onChange={setRange} options={Object.entries(texts.ranges) as [TimeRange, string][]} />
        <span>
          <button type="button" onClick={() => move(-1)}>
            {texts.earlier}
          </button>
          <button type="button" disabled={endMs === null} onClick={() => move(1)}>
            {texts.later}
          </button>
          <button type="button" disabled={endMs === null} onClick={() => setEndMs(null)}>
            {texts.now}
          </button>
        </span>
        <Choice label={texts.view} value={view} onChange={setView} options={Object.entries(texts.views) as ["chart" | "table", string][]} />
      </div>
      {incomplete.length > 0 && <p class="notice warn">{texts.incomplete(incomplete.join(", "))}</p>}
      <Card title={texts.title} data-testid="timeline">
        {fleet.devices.value !== null && robots.length === 0 ? (
          <p>{texts.noRobots}</p>
        ) : value === null || rows === undefined ? (
          <p class="quiet">{common.loading}</p>
        ) : view === "chart" ? (
          <TimelineChart rows={rows} fromMs={value.fromMs} toMs={value.toMs} tickMs={TIME_RANGES[range].tickMs} />
        ) : (
          <TimelineTable rows={rows} />
        )}
      </Card>
    </main>
  );
}
