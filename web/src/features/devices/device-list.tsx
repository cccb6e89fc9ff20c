/** Devices of one space: robots with details first, then room devices. */
import { LastSeenAge, ReachChip } from "./reach-chip";
import type { HealthSummary } from "../../shared/api/health";
import type { DeviceStore } from "./model/device-store";
import type { Fleet } from "./model/device-list";
import { holdingFault } from "./model/faults";
import { isRoomDevice } from "./model/filter";
import { common } from "../../shared/i18n/common";
import { accountLabel } from "../../shared/lib/account-label";
import { format } from "../../shared/i18n/format";
import { MultiRobotCheckbox } from "./selection";
import { texts } from "./texts";
import "./list.css";
import { deviceAddress } from "../../shared/routing/routes";

interface DeviceListsProps {
  devices: readonly DeviceStore[];
  fleet: Fleet;
  /** The cloud's health results by id. Faults that a device reports are shown without them. */
  health?: ReadonlyMap<string, HealthSummary> | undefined;
}

export function DeviceLists({ devices, fleet, health }: DeviceListsProps) {
  const robots = devices.filter(({ info }) => !isRoomDevice(info.value));
  const sensors = devices.filter(({ info }) => isRoomDevice(info.value));
  return (
    <>
      {robots.length > 0 && (
        <ul class="devices" aria-label={texts.list.robots}>
          {robots.map((device) => (
            <RobotRow key={device.id} device={device} fleet={fleet} line={health?.get(device.id)} />
          ))}
        </ul>
      )}
      {sensors.length > 0 && (
        <ul class="tiles" aria-label={texts.list.sensors}>
          {sensors.map((device) => (
            <SensorTile key={device.id} device={device} line={health?.get(device.id)} />
          ))}
        </ul>
      )}
    </>
  );
}

function RobotRow({ device, fleet, line }: { device: DeviceStore; fleet: Fleet; line: HealthSummary | undefined }) {
  const info = device.info.value;
  return (
    <li class="card device-row" data-testid="device-row" data-device={device.id}>
      <MultiRobotCheckbox device={device} />
      <a class="device-name" href={deviceAddress(device.id)}>
        {info.label}
        <span class="quiet">
          {info.name !== info.robot_type && `${info.name} · `}
          {info.robot_type} · {fleet.spaceName(info.space)}
        </span>
      </a>
      <dl>
        <div>
          <dt>{texts.list.status}</dt>
          <dd>
            <Status device={device} />
          </dd>
        </div>
        <div>
          <dt>{texts.list.lastSeen}</dt>
          <dd>
            <LastSeenAge device={device} />
          </dd>
        </div>
        <div>
          <dt>{texts.list.activity}</dt>
          <dd>
            <Activity device={device} line={line} />
          </dd>
        </div>
        <div>
          <dt>{texts.list.control}</dt>
          <dd>
            <Holder device={device} />
          </dd>
        </div>
      </dl>
    </li>
  );
}

function SensorTile({ device, line }: { device: DeviceStore; line: HealthSummary | undefined }) {
  const info = device.info.value;
  const state = device.state.value;
  return (
    <li class="card device-row tile" data-testid="device-row" data-device={device.id}>
      <a class="device-name" href={deviceAddress(device.id)}>
        {info.label}
        <span class="quiet">{info.kind.replaceAll("_", " ")}</span>
      </a>
      <Status device={device} />
      {device.reach.value !== "online" && (
        <span class="quiet small">
          <LastSeenAge device={device} />
        </span>
      )}
      {state !== null && (state.mode !== "idle" || faultsOf(device, line) > 0) && <Activity device={device} line={line} />}
    </li>
  );
}

/** The fault that holds the device, then whether it is online. */
function Status({ device }: { device: DeviceStore }) {
  const fault = holdingFault(device);
  return (
    <span class="status">
      {fault !== null && (
        <span class={`chip bad${device.live.value ? "" : " old"}`} data-testid="holding-fault">
          {texts.list.fault(fault)}
        </span>
      )}
      <ReachChip device={device} data-testid="online" />
    </span>
  );
}

/** Faults from the device or from its measurements, without informational ones. */
export function faultsOf(device: DeviceStore, line: HealthSummary | undefined): number {
  const stored = line === undefined ? 0 : line.counts.error + line.counts.warning;
  return Math.max(stored, device.state.value?.faults.length ?? 0);
}

function Activity({ device, line }: { device: DeviceStore; line: HealthSummary | undefined }) {
  const state = device.state.value;
  if (state === null) return <span class="quiet">{format.unknown}</span>;
  const faults = faultsOf(device, line);
  const activity = state.action === null ? common.mode[state.mode] : texts.list.running(nameOf(state.action));
  return (
    <span class={device.live.value ? "" : "old"}>
      <span class={state.mode === "stopped" || state.mode === "fault" ? "chip bad" : ""}>{activity}</span>{" "}
      {faults > 0 && <span class="chip bad">{texts.list.faults(faults)}</span>}
    </span>
  );
}

function nameOf(action: { name?: string; kind: string }): string {
  return action.name === undefined || action.name === "" ? action.kind : action.name;
}

function Holder({ device }: { device: DeviceStore }) {
  const holder = device.holder.value;
  if (holder === null) return <>{texts.list.noOperator}</>;
  return <>{holder.mine ? texts.list.you : accountLabel(holder.name, holder.account)}</>;
}
