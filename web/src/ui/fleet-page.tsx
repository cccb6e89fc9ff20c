import type { DeviceStore } from "../core/device";
import type { Fleet } from "../core/fleet";
import { texts } from "../texts";
import { PairForm } from "./pair-form";
import { HeardAge, ReachChip } from "./parts";
import { deviceAddress } from "./route";

export function FleetPage({ fleet }: { fleet: Fleet }) {
  const devices = fleet.devices.value;
  return (
    <main class="page fleet" id="content">
      <h1>{texts.fleet.title}</h1>
      {devices === null && <p class="quiet">{texts.loading}</p>}
      {devices?.size === 0 && <p class="quiet">{texts.fleet.none}</p>}
      {devices !== null && devices.size > 0 && (
        <ul class="devices">
          {[...devices.values()].map((device) => (
            <DeviceRow key={device.id} device={device} fleet={fleet} />
          ))}
        </ul>
      )}
      <PairForm fleet={fleet} />
    </main>
  );
}

function DeviceRow({ device, fleet }: { device: DeviceStore; fleet: Fleet }) {
  const info = device.info.value;
  return (
    <li class="card device-row" data-testid="device-row" data-device={device.id}>
      <a class="device-name" href={deviceAddress(device.id)}>
        {info.label}
        <span class="quiet">
          {info.robot_type} · {fleet.spaceName(info.space)}
        </span>
      </a>
      <dl>
        <div>
          <dt>{texts.fleet.status}</dt>
          <dd>
            <ReachChip device={device} data-testid="online" />
          </dd>
        </div>
        <div>
          <dt>{texts.fleet.heard}</dt>
          <dd>
            <HeardAge device={device} />
          </dd>
        </div>
        <div>
          <dt>{texts.fleet.doing}</dt>
          <dd>
            <Doing device={device} />
          </dd>
        </div>
        <div>
          <dt>{texts.fleet.control}</dt>
          <dd>
            <Holder device={device} />
          </dd>
        </div>
      </dl>
    </li>
  );
}

function Doing({ device }: { device: DeviceStore }) {
  const state = device.state.value;
  if (state === null) return <span class="quiet">{texts.number.unknown}</span>;
  const what = state.action === null ? texts.mode[state.mode] : texts.movements.running(nameOf(state.action));
  return (
    <span class={device.live.value ? "" : "old"}>
      <span class={state.mode === "stopped" || state.mode === "fault" ? "chip bad" : ""}>{what}</span>
      {state.faults.length > 0 && <span class="chip bad">{texts.fleet.faults(state.faults.length)}</span>}
    </span>
  );
}

function nameOf(action: { name?: string; kind: string }): string {
  return action.name === undefined || action.name === "" ? action.kind : action.name;
}

function Holder({ device }: { device: DeviceStore }) {
  const holder = device.holder.value;
  if (holder === null) return <>{texts.fleet.nobody}</>;
  return <>{holder.mine ? texts.fleet.you : holder.name}</>;
}
