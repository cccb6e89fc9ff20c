import { DevicePageFrame } from "../control";
/** Health of all devices, those of a space, or one. */
import type { Account } from "../../shared/api/types";
import { LastSeenAge, ReachChip } from "../devices";
import type { DeviceStore, Fleet } from "../devices/model";
import { Age } from "../../shared/ui/age";
import { Choice } from "../../shared/ui/choice";
import { RANK, type HealthSummary, type HealthState } from "../../shared/api/health";
import { useComputed } from "@preact/signals";
import { useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { healthNow, reportedFaults } from "./model/health";
import { toPageClock } from "../../shared/lib/clock";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { DeviceHealthView } from "./device-page";
import { codes, HealthLabel, useReportedFaults } from "./health-chip";
import { usePolling } from "../../shared/hooks/use-polling";
import { healthAddress, healthAddressOf, spaceAddress } from "../../shared/routing/routes";
import "./health.css";

const EVERY_MS = 10_000;
const SERVER_EVERY_MS = 60_000;

interface HealthPageProps {
  api: Api;
  fleet: Fleet;
  account: Account;
  /** The device's id, or empty. */
  device: string;
  /** The space's id, or empty. */
  space: string;
}

export function HealthPage({ device, space, ...rest }: HealthPageProps) {
  if (device === "") return <HealthList api={rest.api} fleet={rest.fleet} space={space} />;
  return (
    <DevicePageFrame {...rest} id={device} page="health">
      {(session) => <DeviceHealthView api={rest.api} device={session.device} />}
    </DevicePageFrame>
  );
}

/** A device with this page's own observation. */
interface DeviceLine {
  line: HealthSummary;
  device: DeviceStore | null;
  health: HealthState;
}

type HealthFilter = "all" | "attention";

function HealthList({ api, fleet, space }: { api: Api; fleet: Fleet; space: string }) {
  const { value, error, refresh } = usePolling(() => api.health.all(space === "" ? null : space), EVERY_MS, [api, space]);
  const server = usePolling(() => api.health.server(), SERVER_EVERY_MS, [api]);
  const problems = [server.value?.broker, server.value?.models].filter((part) => part !== undefined && part !== "ok");
  const [filter, setFilter] = useState<HealthFilter>("all");
  const devices = fleet.devices.value;
  const reported = useComputed(() =>
    [...(fleet.devices.value?.values() ?? [])].map((device) => `${device.id} ${codes(reportedFaults(device))}`).join(" "),
  );
  useReportedFaults(reported.value, refresh);
  const lines = (value ?? []).map((line): DeviceLine => {
    const device = devices?.get(line.device) ?? null;
    const health = device === null ? line.health : healthNow(line.health, reportedFaults(device), device.reach.value);
    return { line, device, health };
  });
  lines.sort((one, other) => RANK[other.health] - RANK[one.health]);
  const countsByHealth = (["fault", "warning", "unknown", "ok"] as const).map(
    (health) => [health, lines.filter((one) => one.health === health).length] as const,
  );
  const shown = filter === "all" ? lines : lines.filter(({ health }) => health !== "ok");
  const spaces = [...new Set([...(devices?.values() ?? [])].map(({ info }) => info.value.space))];
  return (
    <main class="page fleet monitoring" id="content">
      <h1>{space === "" ? texts.health.title : texts.health.titleOf(fleet.spaceName(space))}</h1>
      <p class="quiet">{texts.health.explained}</p>
      <nav class="page-tabs" aria-label={texts.health.spaces}>
        <a href={healthAddress} aria-current={space === "" ? "page" : undefined}>
          {texts.health.everywhere}
        </a>
        {spaces.map((id) => (
          <a key={id} href={healthAddressOf("space", id)} aria-current={space === id ? "page" : undefined}>
            {fleet.spaceName(id)}
          </a>
        ))}
      </nav>
      {error !== "" && <p class="notice bad">{texts.health.failed(error)}</p>}
      {problems.map((reason) => (
        <p key={reason} class="notice bad" data-testid="server-problem">
          {texts.health.server(reason ?? "")}
        </p>
      ))}
      {value === null && error === "" && <p class="quiet">{common.loading}</p>}
      {value !== null && (
        <div class="row health-summary">
          <p role="status" data-testid="health-counts">
            {texts.health.counts(countsByHealth.filter(([, count]) => count > 0).map(([health, count]) => `${count} ${texts.health.state[health].toLowerCase()}`))}
          </p>
          <Choice label={texts.health.show} value={filter} onChange={setFilter} options={Object.entries(texts.health.filters) as [HealthFilter, string][]} />
        </div>
      )}
      {value !== null && shown.length === 0 && <p>{lines.length === 0 ? texts.health.noDevices : texts.health.noneNeedAttention}</p>}
      <ul class="devices" aria-label={texts.health.devices}>
        {shown.map((one) => (
          <Line key={one.line.device} shown={one} fleet={fleet} />
        ))}
      </ul>
      {space !== "" && <a href={spaceAddress(space)}>{texts.health.planOf(fleet.spaceName(space))}</a>}
    </main>
  );
}

function Line({ shown: { line, device, health }, fleet }: { shown: DeviceLine; fleet: Fleet }) {
  const reported = device === null ? null : reportedFaults(device);
  const { worst, counts } = line;
  // The list contains the worst stored fault; add those that only the device reports.
  const unstored = (reported ?? []).filter(({ code }) => code !== worst?.code);
  const stored = counts.error + counts.warning + counts.info;
  return (
    <li class="card health-row" data-testid="health-row" data-device={line.device} data-health={health}>
      <a class="device-name" href={healthAddressOf("device", line.device)}>
        {line.label}
        <span class="quiet">
          {device === null ? "" : `${device.info.value.robot_type.replaceAll("_", " ")} · `}
          {fleet.spaceName(line.space)}
        </span>
      </a>
      <span class="health-status">
        <HealthLabel health={health} />
        {device !== null && <ReachChip device={device} />}
        {device !== null && device.reach.value !== "online" && (
          <span class="quiet small">
            {texts.health.lastSeen}: <LastSeenAge device={device} />
          </span>
        )}
      </span>
      <div class="health-message">
        {worst !== null && (
          <p>
            {worst.message}{" "}
            <span class="quiet">
              {texts.health.since(format.recentTime(Date.parse(worst.raised_at)))}, <Age at={toPageClock(Date.parse(worst.raised_at))} />
              {worst.acknowledged_at !== null && ` · ${texts.health.history.acknowledgedBy(worst.acknowledged_by)}`}
            </span>
          </p>
        )}
        {unstored.map((fault) => (
          <p key={fault.code}>{fault.message}</p>
        ))}
        {stored > 1 && <p class="quiet small">{texts.health.open(stored)}</p>}
        {worst === null && unstored.length === 0 && <p class="quiet">{texts.health.noFault[health === "unknown" ? "unknown" : "ok"]}</p>}
      </div>
    </li>
  );
}
