import type { Account } from "../../shared/api/types";
import { ActionCards, RunStatusPanel } from "../../features/actions";
import { ControlBar, StopBanner, useDeviceSessions } from "../../features/control";
import type { DeviceSession } from "../../features/control/model";
import { CameraConsentCard, deviceTexts as texts, EventLog, LastSeenAge, RateNotice, ReachChip, RenameDevice } from "../../features/devices";
import type { DeviceStore, Fleet } from "../../features/devices/model";
import { HealthChip } from "../../features/health";
import { PageExplainer } from "../../shared/help";
import { CommandTraceCard } from "../../features/latency";
import { MovementsCard } from "../../features/movements";
import { CameraSwitcher, SettingsCard, useCameraSources } from "../../features/sensors";
import { RoomDeviceAction } from "../../features/sensors/model";
import { AccessList, goToAccess } from "../../features/sharing";
import { SteeringCard } from "../../features/steering";
import { JointPoseTable, TelemetryPlot, TwinView } from "../../features/twin";
import type { ComponentChildren } from "preact";
import { useMemo, useRef } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { common } from "../../shared/i18n/common";
import { RoomDevicePage } from "./room-device-page";
import "./robot-page.css";
import { CollapsibleCard } from "../../shared/ui/collapsible-card";
import { autonomyAddressOf, deviceListAddress, keyframesAddress, replaceWith, spaceAddress, latencyAddressOf } from "../../shared/routing/routes";

interface DevicePageProps {
  api: Api;
  fleet: Fleet;
  id: string;
  account: Account;
}

export function DevicePage({ api, fleet, id, account }: DevicePageProps) {
  const devices = fleet.devices.value;
  const device = devices?.get(id);
  const lastLabel = useRef("");
  if (device !== undefined) lastLabel.current = device.info.value.label;
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
        {lastLabel.current === "" ? (
          <p>{common.deviceMissing}</p>
        ) : (
          <div role="alert" class="no-access" data-testid="no-access">
            <h1>{texts.device.accessLost(lastLabel.current)}</h1>
            <p>{texts.device.accessLostReason}</p>
          </div>
        )}
        <p>
          <a class="elsewhere" href={deviceListAddress}>
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
  const [session] = useDeviceSessions(api, fleet, [device], account);
  if (session === undefined) return null;
  const { control, stop } = session;
  const description = device.description.value;
  const robot = description?.joints.length !== 0;
  const access = <DeviceAccess api={api} fleet={fleet} device={device} account={account} />;
  return (
    <>
      <ControlBar session={session} watchers={session.watchers} />
      <main class="page operate" id="content">
        <Heading api={api} device={device} fleet={fleet} />
        <StopBanner device={device} stop={stop} />
        <RateNotice device={device} />
        <PageExplainer page={robot ? "device" : "roomDevice"} />
        {(robot || description.behaviours.length > 0) && <RunStatusPanel device={device} control={control} actions={session.actions} />}
        {robot ? (
          <RobotColumns api={api} fleet={fleet} session={session} account={account} access={access} />
        ) : (
          <RoomDevicePage api={api} fleet={fleet} session={session} access={access} />
        )}
      </main>
    </>
  );
}

interface RobotColumnsProps {
  api: Api;
  fleet: Fleet;
  session: DeviceSession;
  account: Account;
  access: ComponentChildren;
}

/** A robot's page: views, steering and actions in three columns; one column on a phone. */
function RobotColumns({ api, fleet, session, account, access }: RobotColumnsProps) {
  const { device, control, actions } = session;
  const views = useCameraSources(fleet, device);
  const type = device.info.value.robot_type;
  const settings = useMemo(() => new RoomDeviceAction(api, device, actions, () => control.epoch), [api, device, actions, control]);
  const hasSettings = (device.description.value?.controls.length ?? 0) > 0;
  return (
    <div class="desk robot">
      <div class="column">
        <CollapsibleCard name="view" title={texts.cards.view} type={type} always>
          <TwinView device={device} control={control} />
        </CollapsibleCard>
        {views.length > 0 && (
          <CollapsibleCard name="camera" title={texts.cards.camera} type={type}>
            <CameraSwitcher device={device} views={views} />
          </CollapsibleCard>
        )}
        {(device.state.value?.camera_consent ?? null) !== null && (
          <CollapsibleCard name="consent" title={texts.cards.consent} type={type}>
            <CameraConsentCard api={api} device={device} />
          </CollapsibleCard>
        )}
        <CollapsibleCard name="plot" title={texts.cards.plot} type={type}>
          <TelemetryPlot device={device} />
        </CollapsibleCard>
        <CollapsibleCard name="poses" title={texts.cards.poses} type={type}>
          <JointPoseTable device={device} />
        </CollapsibleCard>
      </div>
      <div class="column">
        <CollapsibleCard name="steer" title={texts.cards.steering} type={type} always>
          <SteeringCard session={session} onStop={() => session.stopNow()} />
        </CollapsibleCard>
        <CollapsibleCard name="times" title={texts.cards.latency} type={type}>
          <CommandTraceCard session={session} />
        </CollapsibleCard>
      </div>
      <div class="column">
        <ActionCards fleet={fleet} session={session} />
        {hasSettings && (
          <CollapsibleCard name="settings" title={texts.cards.settings} type={type}>
            <SettingsCard device={device} roomAction={settings} />
          </CollapsibleCard>
        )}
        <CollapsibleCard name="movements" title={texts.cards.movements} type={type}>
          <MovementsCard api={api} device={device} control={control} actions={actions} account={account.id} />
        </CollapsibleCard>
        <CollapsibleCard name="events" title={texts.cards.events} type={type}>
          <EventLog device={device} />
        </CollapsibleCard>
        {access}
      </div>
    </div>
  );
}

function DeviceAccess({ api, fleet, device, account }: OperateProps) {
  const { agent, id, owner, role, space } = device.info.value;
  const agentDevices = [...(fleet.devices.value?.values() ?? [])].filter(({ info }) => info.value.agent === agent);
  return (
    <AccessList
      api={api}
      account={account}
      target={{ kind: "device", id }}
      unit={{ kind: "agent", id: agent }}
      included={agentDevices.map(({ info }) => info.value.label)}
      owner={owner}
      role={role}
      space={{ id: space, name: fleet.spaceName(space) }}
      onLeft={() => {
        void fleet.refresh();
        replaceWith(deviceListAddress);
      }}
    />
  );
}

function Heading({ api, device, fleet }: { api: Api; device: DeviceStore; fleet: Fleet }) {
  const info = device.info.value;
  const parseError = device.parseError.value;
  const robot = (device.description.value?.joints.length ?? 0) > 0;
  return (
    <div class="heading">
      <a href={deviceListAddress}>← {common.allDevices}</a>
      <h1>{info.label}</h1>
      <p class="quiet">
        {info.robot_type.replaceAll("_", " ")} · <a href={spaceAddress(info.space)}>{fleet.spaceName(info.space)}</a>
        {device.description.value?.simulated === true && ` · ${texts.device.simulated}`}
      </p>
      <p class="reach">
        <ReachChip device={device} data-testid="online" />
        <HealthChip api={api} device={device} />
        <a class="chip" href={latencyAddressOf(device.id)}>
          {texts.pages.latency}
        </a>
        {robot && (
          <a class="chip" href={autonomyAddressOf(device.id)} data-testid="to-autonomy">
            {texts.pages.autonomy}
          </a>
        )}
        <span class="quiet">
          {texts.list.lastSeen}: <LastSeenAge device={device} />
        </span>
        {robot && (
          <a href={keyframesAddress(info.id)} data-testid="to-keyframes">
            {texts.cards.keyframes}
          </a>
        )}
        <RenameDevice api={api} device={device} />
        <button type="button" class="plain" onClick={goToAccess}>
          {texts.cards.access}
        </button>
      </p>
      {info.incompatible !== null && (
        <p class="notice warn" data-testid="incompatible">
          {info.incompatible}
        </p>
      )}
      {parseError !== null && <p class="notice warn">{texts.device.unreadable(parseError)}</p>}
    </div>
  );
}
