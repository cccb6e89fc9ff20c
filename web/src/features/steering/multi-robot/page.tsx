/** Several robots on one page, each with its own control; one key and one button stop them all. */
import type { Account } from "../../../shared/api/types";
import { ControlBar, StopBanner } from "../../control";
import { LastSeenAge, ReachChip, useDeviceSessions } from "../../devices";
import type { DeviceSession, DeviceStore, Fleet } from "../../devices/model";
import { TwinView } from "../../twin";
import { useMemo, useState } from "preact/hooks";
import type { Api } from "../../../shared/api/client";
import { common } from "../../../shared/i18n/common";
import { format } from "../../../shared/i18n/format";
import { texts } from "../texts";
import { deviceAddress, deviceListAddress } from "../../../shared/routing/routes";
import { SteeringCard } from "../steering-card";
import "./multi-robot.css";

interface TogetherPageProps {
  api: Api;
  fleet: Fleet;
  /** Of the devices, with commas between. */
  ids: string;
  account: Account;
}

export function MultiRobotPage({ api, fleet, ids: asked, account }: TogetherPageProps) {
  const ids = useMemo(() => [...new Set(asked.split(","))], [asked]);
  const all = fleet.devices.value;
  const devices = ids.map((id) => all?.get(id)).filter((device) => device !== undefined);
  const sessions = useDeviceSessions(api, fleet, devices, account);
  const [chosen, setChosen] = useState<string | null>(null);
  const active = sessions.find(({ device }) => device.id === chosen) ?? sessions[0];
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
              onChoose={() => setChosen(session.device.id)}
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
  onChoose: () => void;
  onStop: () => void;
}

/** One robot: who touches it chooses it for keys and gamepad. */
function RobotPanel({ session, active, onChoose, onStop }: RobotPanelProps) {
  const { device, control, stop } = session;
  const { label } = device.info.value;
  return (
    <section
      class={`robot-panel ${active ? "chosen" : ""}`}
      aria-label={label}
      data-testid="robot-panel"
      data-device={device.id}
      data-chosen={active}
      onPointerDownCapture={onChoose}
      onFocusCapture={onChoose}
    >
      <header class="robot-panel-head">
        <h2>
          <a href={deviceAddress(device.id)}>{label}</a>
        </h2>
        <ReachChip device={device} data-testid="online" />
        <Doing device={device} />
        {/* The same words either way: what moves under a pointer that has just gone down gets no click. */}
        <button type="button" class="choose" aria-pressed={active} data-testid="choose" onClick={onChoose}>
          {texts.multiRobot.keysHere}
        </button>
      </header>
      <ControlBar device={device} control={control} stop={stop} watching={session.watchers} />
      <StopBanner device={device} stop={stop} />
      <TwinView device={device} control={control} />
      <SteeringCard session={session} active={active} onStop={onStop} />
    </section>
  );
}

function Doing({ device }: { device: DeviceStore }) {
  const state = device.state.value;
  return (
    <span class={`quiet small ${device.live.value ? "" : "old"}`}>
      {state === null ? format.unknown : common.mode[state.mode]} · <LastSeenAge device={device} />
    </span>
  );
}
