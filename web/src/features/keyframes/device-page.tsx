/** The keyframe editor of one device. */
import type { Account } from "../../shared/api/types";
import { ControlBar, StopBanner, useDeviceSessions } from "../control";
import { ReachChip } from "../devices";
import type { DeviceStore, Fleet } from "../devices/model";
import type { Api } from "../../shared/api/client";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";
import { deviceAddress, deviceListAddress, keyframesAddress } from "../../shared/routing/routes";
import { KeyframeEditor } from "./editor";
import { LoadMovement, useMovementSource } from "./load-movement";
import { measuredPose } from "./preview-twin";

interface KeyframesPageProps {
  api: Api;
  fleet: Fleet;
  account: Account;
  id: string;
  name: string;
}

export function KeyframesPage({ api, fleet, account, id, name }: KeyframesPageProps) {
  const devices = fleet.devices.value;
  const device = devices?.get(id);
  if (device === undefined) {
    return (
      <main class="page" id="content">
        <p class="quiet">{devices === null ? common.loading : common.deviceMissing}</p>
        {devices !== null && <a href={deviceListAddress}>{common.allDevices}</a>}
      </main>
    );
  }
  return <OfDevice key={id} api={api} fleet={fleet} account={account} device={device} name={name} />;
}

interface OfDeviceProps {
  api: Api;
  fleet: Fleet;
  account: Account;
  device: DeviceStore;
  name: string;
}

function OfDevice({ api, fleet, account, device, name }: OfDeviceProps) {
  const [session] = useDeviceSessions(api, fleet, [device], account);
  const { robot_type: robotType, label } = device.info.value;
  const loaded = useMovementSource(api, robotType, name);
  if (session === undefined) return null;
  return (
    <>
      <ControlBar session={session} />
      <main class="page operate kf-page" id="content">
        <div class="heading">
          <a href={deviceAddress(device.id)}>← {label}</a>
          <h1>{texts.title}</h1>
          <p class="quiet">
            {robotType.replaceAll("_", " ")}
            {name !== "" && ` · ${name}`}
          </p>
          <p class="reach">
            <ReachChip device={device} data-testid="online" />
          </p>
        </div>
        <StopBanner device={device} stop={session.stop} />
        <LoadMovement robotType={robotType} name={name} {...loaded}>
          {(source) => (
            <KeyframeEditor
              api={api}
              name={name}
              source={source}
              robotType={robotType}
              robot={device.description.value}
              twin={device.twin.value}
              measured={measuredPose(device)}
              // A new movement starts at the robot's measured pose, so wait for it unless the robot is offline.
              waitsForPose={measuredPose(device) === null && device.reach.value !== "offline"}
              session={session}
              address={(saved) => keyframesAddress(device.id, saved)}
            />
          )}
        </LoadMovement>
      </main>
    </>
  );
}
