/** Several robots on one page, each with its own control; one key and one button stop them all. */
import type { Account } from "../../../shared/api/types";
import { ControlBar, StopBanner, StopOutcomes, useDeviceSessions } from "../../control";
import { LastSeenAge, ReachChip } from "../../devices";
import type { DeviceSession } from "../../control/model";
import type { DeviceStore, Fleet } from "../../devices/model";
import { TwinView } from "../../twin";
import { useMemo, useState } from "preact/hooks";
import type { Api } from "../../../shared/api/client";
import { common } from "../../../shared/i18n/common";
import { format } from "../../../shared/i18n/format";
import { texts } from "../texts";
import { deviceAddress, deviceListAddress } from "../../../shared/routing/routes";
import { SteeringCard } from "../steering-card";
import "./multi-robot.css";

interface MultiRobotPageProps {
  api: Api;
  fleet: Fleet;
  /** Device ids, separated by commas. */
  ids: string;
  account: Account;
}

export function MultiRobotPage({ api, fleet, ids: idList, account }: MultiRobotPageProps) {
  const ids = useMemo(() => [...new Set(idList.split(","))], [idList]);
  const all = fleet.devices.value;
  const devices = ids.map((id) => all?.get(id)).filter((device) => device !== undefined);
  const sessions = useDeviceSessions(api, fleet, devices, account);
  const [selectedId, setSelectedId] = useState<string | null>(null);
  const active = sessions.find(({ device }) => device.id === selectedId) ?? sessions[0];
  const stopAll = (): void => {
    for (const session of sessions) session.stopNow();
  };
  const stoppable = devices.some(({ info }) => info.value.role !== "viewer");
  return (
    <>
      <div class="control-bar all-bar" role="region" aria-label={texts.multiRobot.stopAll}>
        <p class="control-state" role="status" data-testid="keys-for">
          {active !== undefined && texts.multiRobot.keysFor(active.device.info.value.label)}
        </p>
        <button
          type="button"
          class="stop"
          data-testid="stop-all"
          disabled={!stoppable}
          title={texts.multiRobot.stopAllExplained}
          aria-keyshortcuts="Escape"
          onClick={stopAll}
        >
          {texts.multiRobot.stopAll} <kbd>{texts.multiRobot.stopKey}</kbd>
        </button>
        <StopOutcomes sessions={sessions} />
      </div>
      <main class="page operate together" id="content">
        <div class="heading">
          <a href={deviceListAddress}>← {common.allDevices}</a>
          <h1>{texts.multiRobot.title(devices.length)}</h1>
        </div>
        {all === null && <p class="quiet">{common.loading}</p>}
        {all !== null && devices.length < ids.length && <p class="notice warn">{texts.multiRobot.missing}</p>}
        <div class="robot-panels">
          {sessions.map((session) => (
            <RobotPanel
              key={session.device.id}
              session={session}
              active={session === active}
              onSelect={() => setSelectedId(session.device.id)}
              onStop={stopAll}
            />
          ))}
        </div>
      </main>
    </>
  );
}

interface RobotPanelProps {
  session: DeviceSession;
  active: boolean;
  onSelect: () => void;
  onStop: () => void;
}

/** One robot. A pointer press or focus inside selects it for keyboard and gamepad. */
function RobotPanel({ session, active, onSelect, onStop }: RobotPanelProps) {
  const { device, control, stop } = session;
  const { label } = device.info.value;
  return (
    <section
      class={`robot-panel ${active ? "chosen" : ""}`}
      aria-label={label}
      data-testid="robot-panel"
      data-device={device.id}
      data-chosen={active}
      onPointerDownCapture={onSelect}
      onFocusCapture={onSelect}
    >
      <header class="robot-panel-head">
        <h2>
          <a href={deviceAddress(device.id)}>{label}</a>
        </h2>
        <ReachChip device={device} data-testid="online" />
        <ModeAndLastSeen device={device} />
        {/* The label never changes: a button that moves during a pointer press receives no click. */}
        <button type="button" class="choose" aria-pressed={active} data-testid="choose" onClick={onSelect}>
          {texts.multiRobot.keysHere}
        </button>
      </header>
      <ControlBar session={session} watchers={session.watchers} />
      <StopBanner device={device} stop={stop} />
      <TwinView device={device} control={control} />
      <SteeringCard session={session} active={active} onStop={onStop} />
    </section>
  );
}

function ModeAndLastSeen({ device }: { device: DeviceStore }) {
  const state = device.state.value;
  return (
    <span class={`quiet small ${device.live.value ? "" : "old"}`}>
      {state === null ? format.unknown : common.mode[state.mode]} · <LastSeenAge device={device} />
    </span>
  );
}
