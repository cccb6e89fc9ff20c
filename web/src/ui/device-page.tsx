import { useEffect, useState } from "preact/hooks";
import { ActionRunner } from "../core/action";
import type { Account, Api } from "../core/api";
import { Control } from "../core/control";
import type { DeviceStore } from "../core/device";
import type { Fleet } from "../core/fleet";
import { StopSwitch } from "../core/stop";
import { texts } from "../texts";
import { ControlBar } from "./control-bar";
import { Events } from "./events";
import { JointSliders } from "./joint-sliders";
import { Latency } from "./latency";
import { Movements } from "./movements";
import { HeardAge, ReachChip } from "./parts";
import { Plot } from "./plot";
import { PoseTable } from "./pose-table";
import { fleetAddress } from "./route";
import { StopBanner } from "./stop";
import { View3D } from "./view-3d";

interface DevicePageProps {
  api: Api;
  fleet: Fleet;
  id: string;
  account: Account;
}

export function DevicePage({ api, fleet, id, account }: DevicePageProps) {
  const devices = fleet.devices.value;
  const device = devices?.get(id);
  if (devices === null) {
    return (
      <main class="page" id="content">
        <p class="quiet">{texts.loading}</p>
      </main>
    );
  }
  if (device === undefined) {
    return (
      <main class="page" id="content">
        <p>{texts.device.missing}</p>
        <a href={fleetAddress}>{texts.device.back}</a>
      </main>
    );
  }
  return <Operate key={device.id} api={api} fleet={fleet} device={device} account={account} />;
}

interface Tools {
  control: Control;
  stop: StopSwitch;
  actions: ActionRunner;
}

interface OperateProps {
  api: Api;
  fleet: Fleet;
  device: DeviceStore;
  account: Account;
}

function Operate({ api, fleet, device, account }: OperateProps) {
  const [desk, setDesk] = useState<Tools | null>(null);

  useEffect(() => {
    const unwatch = device.watchClosely();
    const control = new Control(api, device);
    const stop = new StopSwitch(api, device, fleet.link, account.name);
    const actions = new ActionRunner(api, device);
    setDesk({ control, stop, actions });

    const press = (event: KeyboardEvent): void => {
      if (event.key !== "Escape" || event.repeat) return;
      event.preventDefault();
      control.stopped();
      stop.press();
    };
    const visibility = (): void => {
      if (document.visibilityState === "hidden") control.hidden();
    };
    const leave = (): void => void control.release(true);
    // In the capture phase: no field or menu may keep the key from stopping the robot.
    addEventListener("keydown", press, { capture: true });
    document.addEventListener("visibilitychange", visibility);
    addEventListener("pagehide", leave);
    return () => {
      removeEventListener("keydown", press, { capture: true });
      document.removeEventListener("visibilitychange", visibility);
      removeEventListener("pagehide", leave);
      control.dispose();
      stop.dispose();
      actions.dispose();
      unwatch();
    };
  }, [api, fleet, device, account]);

  if (desk === null) return null;
  const { control, stop, actions } = desk;
  return (
    <>
      <ControlBar device={device} control={control} stop={stop} />
      <main class="page operate" id="content">
        <Heading device={device} fleet={fleet} />
        <StopBanner device={device} stop={stop} />
        {device.description.value?.joints.length === 0 ? (
          <>
            <p class="quiet">{texts.device.still}</p>
            <Events device={device} />
          </>
        ) : (
          <Desk api={api} device={device} control={control} actions={actions} />
        )}
      </main>
    </>
  );
}

/** What moves joints, and shows how they move. */
function Desk({ api, device, control, actions }: Omit<Tools, "stop"> & { api: Api; device: DeviceStore }) {
  return (
    <div class="desk">
      <div class="column">
        <View3D device={device} control={control} />
        <Plot device={device} />
        <PoseTable device={device} />
      </div>
      <div class="column">
        <JointSliders device={device} control={control} />
        <Movements api={api} device={device} control={control} actions={actions} />
        <Latency device={device} control={control} />
        <Events device={device} />
      </div>
    </div>
  );
}

function Heading({ device, fleet }: { device: DeviceStore; fleet: Fleet }) {
  const info = device.info.value;
  const trouble = device.trouble.value;
  return (
    <div class="heading">
      <a href={fleetAddress}>← {texts.device.back}</a>
      <h1>{info.label}</h1>
      <p class="quiet">
        {info.robot_type} · {fleet.spaceName(info.space)}
        {device.description.value?.simulated === true && ` · ${texts.device.simulated}`}
      </p>
      <p class="reach">
        <ReachChip device={device} data-testid="online" />
        <span class="quiet">
          {texts.fleet.heard}: <HeardAge device={device} />
        </span>
      </p>
      {trouble !== null && <p class="notice warn">{texts.device.unreadable(trouble)}</p>}
    </div>
  );
}
