import type { ComponentChildren } from "preact";
import { useRef } from "preact/hooks";
import type { Account, Api } from "../../shared/api/client";
import type { DeviceStore } from "./model/device-store";
import type { Fleet } from "./model/device-list";
import type { Station } from "./model/device-session";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";
import { Access, goToAccess } from "../sharing/access-list";
import { Acts } from "../actions/action-cards";
import { RunStatus } from "../actions/run-status";
import { ControlBar } from "../control/control-bar";
import "./robot-page.css";
import { Events } from "./event-log";
import { Times } from "../control/command-trace-card";
import { Foldable } from "../../shared/ui/collapsible-card";
import { WhatDoISee } from "../help/page-explainer";
import { HealthChip } from "../health/health-chip";
import { Movements } from "../movements/movements-card";
import { Naming } from "./rename";
import { HeardAge, ReachChip } from "../../shared/ui/parts";
import { Plot } from "../twin/telemetry-plot";
import { PoseTable } from "../twin/joint-pose-table";
import { RoomDesk } from "../sensors/room-device-page";
import { fleetAddress, keyframesAddress, replaceWith, spaceAddress, timesAddressOf } from "../../app/routes";
import { useStations } from "./device-sessions";
import { SteerCard } from "../steering/steering-card";
import { StopBanner } from "../control/stop-button";
import { View3D } from "../twin/twin-view";
import { useViews, Watching } from "../sensors/camera-switcher";

interface DevicePageProps {
  api: Api;
  fleet: Fleet;
  id: string;
  account: Account;
}

export function DevicePage({ api, fleet, id, account }: DevicePageProps) {
  const devices = fleet.devices.value;
  const device = devices?.get(id);
  const shown = useRef("");
  if (device !== undefined) shown.current = device.info.value.label;
  if (devices === null) {
    return (
      <main class="page" id="content">
        <p class="quiet">{common.loading}</p>
      </main>
    );
  }
  if (device === undefined) {
    return (
      <main class="narrow" id="content">
        {shown.current === "" ? (
          <p>{common.deviceMissing}</p>
        ) : (
          <div role="alert" class="no-access" data-testid="no-access">
            <h1>{texts.device.gone(shown.current)}</h1>
            <p>{texts.device.goneWhy}</p>
          </div>
        )}
        <p>
          <a class="elsewhere" href={fleetAddress}>
            {common.allDevices}
          </a>
        </p>
      </main>
    );
  }
  return <Operate key={device.id} api={api} fleet={fleet} device={device} account={account} />;
}

interface OperateProps {
  api: Api;
  fleet: Fleet;
  device: DeviceStore;
  account: Account;
}

function Operate({ api, fleet, device, account }: OperateProps) {
  const [station] = useStations(api, fleet, [device], account);
  if (station === undefined) return null;
  const { control, stop } = station;
  const robot = device.description.value?.joints.length !== 0;
  const access = <DeviceAccess api={api} fleet={fleet} device={device} account={account} />;
  return (
    <>
      <ControlBar device={device} control={control} stop={stop} watching={station.watching} />
      <main class="page operate" id="content">
        <Heading api={api} device={device} fleet={fleet} />
        <StopBanner device={device} stop={stop} />
        <WhatDoISee page={robot ? "device" : "roomDevice"} />
        {robot && <RunStatus device={device} control={control} actions={station.actions} />}
        {robot ? (
          <Desk api={api} fleet={fleet} station={station} account={account} access={access} />
        ) : (
          <RoomDesk api={api} fleet={fleet} station={station} access={access} />
        )}
      </main>
    </>
  );
}

interface DeskProps {
  api: Api;
  fleet: Fleet;
  station: Station;
  account: Account;
  access: ComponentChildren;
}

/** What is seen of a robot, what steers it, and what it is asked to do: three columns, on a phone one below the other. */
function Desk({ api, fleet, station, account, access }: DeskProps) {
  const { device, control, actions } = station;
  const views = useViews(fleet, device);
  const type = device.info.value.robot_type;
  return (
    <div class="desk robot">
      <div class="column">
        <Foldable name="view" title={texts.cards.view} type={type} always>
          <View3D device={device} control={control} />
        </Foldable>
        {views.length > 0 && (
          <Foldable name="camera" title={texts.cards.camera} type={type}>
            <Watching device={device} views={views} />
          </Foldable>
        )}
        <Foldable name="plot" title={texts.cards.plot} type={type}>
          <Plot device={device} />
        </Foldable>
        <Foldable name="poses" title={texts.cards.poses} type={type}>
          <PoseTable device={device} />
        </Foldable>
      </div>
      <div class="column">
        <Foldable name="steer" title={texts.cards.steering} type={type} always>
          <SteerCard station={station} onStop={() => station.stopNow()} />
        </Foldable>
        <Foldable name="times" title={texts.cards.latency} type={type}>
          <Times station={station} />
        </Foldable>
      </div>
      <div class="column">
        <Acts fleet={fleet} station={station} />
        <Foldable name="movements" title={texts.cards.movements} type={type}>
          <Movements api={api} device={device} control={control} actions={actions} account={account.id} />
        </Foldable>
        <Foldable name="events" title={texts.cards.events} type={type}>
          <Events device={device} />
        </Foldable>
        {access}
      </div>
    </div>
  );
}

function DeviceAccess({ api, fleet, device, account }: OperateProps) {
  const { agent, id, owner, role, space } = device.info.value;
  const behindIt = [...(fleet.devices.value?.values() ?? [])].filter(({ info }) => info.value.agent === agent);
  return (
    <Access
      api={api}
      account={account}
      target={{ kind: "device", id }}
      whole={{ kind: "agent", id: agent }}
      goes={behindIt.map(({ info }) => info.value.label)}
      owner={owner}
      role={role}
      space={{ id: space, name: fleet.spaceName(space) }}
      onLeft={() => {
        void fleet.refresh();
        replaceWith(fleetAddress);
      }}
    />
  );
}

function Heading({ api, device, fleet }: { api: Api; device: DeviceStore; fleet: Fleet }) {
  const info = device.info.value;
  const trouble = device.trouble.value;
  return (
    <div class="heading">
      <a href={fleetAddress}>← {common.allDevices}</a>
      <h1>{info.label}</h1>
      <p class="quiet">
        {info.robot_type.replaceAll("_", " ")} · <a href={spaceAddress(info.space)}>{fleet.spaceName(info.space)}</a>
        {device.description.value?.simulated === true && ` · ${texts.device.simulated}`}
      </p>
      <p class="reach">
        <ReachChip device={device} data-testid="online" />
        <HealthChip api={api} device={device} />
        <a class="chip" href={timesAddressOf(device.id)}>
          {texts.pages.latency}
        </a>
        <span class="quiet">
          {texts.list.heard}: <HeardAge device={device} />
        </span>
        {(device.description.value?.joints.length ?? 0) > 0 && (
          <a href={keyframesAddress(info.id)} data-testid="to-keyframes">
            {texts.cards.keyframes}
          </a>
        )}
        <Naming api={api} device={device} />
        <button type="button" class="plain" onClick={goToAccess}>
          {texts.cards.access}
        </button>
      </p>
      {trouble !== null && <p class="notice warn">{texts.device.unreadable(trouble)}</p>}
    </div>
  );
}
