/** Sessions of the devices that a page operates. */
import type { Account } from "../../shared/api/types";
import { useEffect, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import type { DeviceStore, Fleet } from "../devices/model";
import { storage } from "../../shared/hooks/browser-storage";
import { storedTransport } from "../../shared/lib/local-storage";
import { DeviceSession } from "./model/device-session";
import { SetpointPreference } from "./model/setpoint-preference";

/** One session per device, in order; none before the page is mounted. One key stops all of them. */
export function useDeviceSessions(
  api: Api,
  fleet: Fleet,
  devices: readonly DeviceStore[],
  account: Account,
): readonly DeviceSession[] {
  const [sessions, setSessions] = useState<readonly DeviceSession[]>([]);
  const ids = devices.map(({ id }) => id).join(" ");

  useEffect(() => {
    // Without a device, do not handle the Stop key.
    if (devices.length === 0) return undefined;
    const preferred = new SetpointPreference(storedTransport(storage()));
    const created = devices.map((device) => new DeviceSession(api, fleet.link, device, account.id, preferred));
    setSessions(created);
    const reportVisibility = (): void => {
      for (const { watchers: watching } of created) watching.setVisible(document.visibilityState === "visible");
    };
    reportVisibility();

    const stopOnEscape = (event: KeyboardEvent): void => {
      if (event.key !== "Escape" || event.repeat) return;
      event.preventDefault();
      for (const session of created) session.stopNow();
    };
    const visibility = (): void => {
      reportVisibility();
      if (document.visibilityState !== "hidden") return;
      for (const { control } of created) control.onHidden();
    };
    // While the page has no focus it receives no keyup events.
    const blur = (): void => {
      for (const { control } of created) control.streamer.value?.release();
    };
    const leave = (): void => {
      for (const { control, watchers: watching } of created) {
        void control.release(true);
        watching.setVisible(false);
      }
    };
    // In the capture phase, so that no field or menu can block the Stop key.
    addEventListener("keydown", stopOnEscape, { capture: true });
    document.addEventListener("visibilitychange", visibility);
    addEventListener("blur", blur);
    addEventListener("pagehide", leave);
    return () => {
      removeEventListener("keydown", stopOnEscape, { capture: true });
      document.removeEventListener("visibilitychange", visibility);
      removeEventListener("blur", blur);
      removeEventListener("pagehide", leave);
      for (const session of created) session.dispose();
      setSessions([]);
    };
    // Devices change only with their ids.
  }, [api, fleet, ids, account]);

  return sessions;
}
