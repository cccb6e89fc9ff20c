/** The frame of a device's secondary pages: name, control, Stop and links to its other pages. */
import type { Account } from "../../shared/api/types";
import { ControlBar } from "./control-bar";
import { deviceTexts as texts, LastSeenAge, ReachChip } from "../devices";
import type { DeviceStore, Fleet } from "../devices/model";
import { StopBanner } from "./stop-button";
import type { ComponentChildren } from "preact";
import type { Api } from "../../shared/api/client";
import type { DeviceSession } from "./model/device-session";
import { common } from "../../shared/i18n/common";
import { autonomyAddressOf, deviceAddress, deviceListAddress, healthAddressOf, latencyAddressOf } from "../../shared/routing/routes";
import { useDeviceSessions } from "./device-sessions";
import "./page-frame.css";

interface DeviceFrameProps {
  api: Api;
  fleet: Fleet;
  account: Account;
  id: string;
  page: "health" | "latency" | "autonomy" | "session";
  children: (session: DeviceSession) => ComponentChildren;
}

export function DevicePageFrame({ id, ...rest }: DeviceFrameProps) {
  const devices = rest.fleet.devices.value;
  const device = devices?.get(id);
  if (device !== undefined) return <DevicePage key={id} device={device} {...rest} />;
  return (
    <main class="narrow" id="content">
      <p role="status">{devices === null ? common.loading : common.deviceMissing}</p>
      <a href={deviceListAddress}>{common.allDevices}</a>
    </main>
  );
}

interface FramedProps extends Omit<DeviceFrameProps, "id"> {
  device: DeviceStore;
}

function DevicePage({ api, fleet, account, device, page, children }: FramedProps) {
  const [session] = useDeviceSessions(api, fleet, [device], account);
  if (session === undefined) return null;
  const { label } = device.info.value;
  const joints = device.description.value?.joints.length;
  // Without joints nothing moves. Before the description arrives, the open page is listed.
  const robot = joints === undefined ? page === "autonomy" || page === "session" : joints > 0;
  const pages = [
    [texts.pages.device, deviceAddress(device.id), false],
    [texts.pages.health, healthAddressOf("device", device.id), page === "health"],
    [texts.pages.latency, latencyAddressOf(device.id), page === "latency"],
    ...(robot ? [[texts.pages.autonomy, autonomyAddressOf(device.id), page === "autonomy"] as const] : []),
  ] as const;
  return (
    <>
      <ControlBar session={session} />
      <main class="page operate monitoring" id="content">
        <div class="heading">
          <a href={deviceListAddress}>← {common.allDevices}</a>
          <h1>{texts.pages.title[page](label)}</h1>
          <p class="reach">
            <ReachChip device={device} data-testid="online" />
            <span class="quiet">
              {texts.list.lastSeen}: <LastSeenAge device={device} />
            </span>
          </p>
          <nav class="page-tabs" aria-label={texts.pages.of(label)}>
            {pages.map(([name, address, current]) => (
              <a key={address} href={address} aria-current={current ? "page" : undefined}>
                {name}
              </a>
            ))}
          </nav>
        </div>
        {device.info.value.incompatible !== null && (
          <p class="notice warn" data-testid="incompatible">
            {device.info.value.incompatible}
          </p>
        )}
        <StopBanner device={device} stop={session.stop} />
        {children(session)}
      </main>
    </>
  );
}
