/** Sessions of the devices that a page operates. */
import type { Account } from "../../shared/api/types";
import { useEffect, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import type { DeviceStore } from "./model/device-store";
import type { Fleet } from "./model/device-list";
import { DeviceSession } from "./model/device-session";

/** One session per device, in order; none before the page is mounted. One key stops all of them. */
export function useDeviceSessions(
  api: Api,
  fleet: Fleet,
  devices: readonly DeviceStore[],
  account: Account,
): readonly DeviceSession[] {
  const [sessions, setStations] = useState<readonly DeviceSession[]>([]);
  const ids = devices.map(({ id }) => id).join(" ");

  useEffect(() => {
    // Without a device the key stays unused.
    if (devices.length === 0) return undefined;
    const made = devices.map((device) => new DeviceSession(api, fleet.link, device, account.name));
    setStations(made);
    const look = (): void => {
      for (const { watchers: watching } of made) watching.seen(document.visibilityState === "visible");
    };
    look();

    const press = (event: KeyboardEvent): void => {
      if (event.key !== "Escape" || event.repeat) return;
      event.preventDefault();
      for (const session of made) session.stopNow();
    };
    const visibility = (): void => {
      look();
      if (document.visibilityState !== "hidden") return;
      for (const { control } of made) control.hidden();
    };
    // While the page has no focus it receives no keyup events.
    const blur = (): void => {
      for (const { control } of made) control.streamer.value?.release();
    };
    const leave = (): void => {
      for (const { control, watchers: watching } of made) {
        void control.release(true);
        watching.seen(false);
      }
    };
    // In the capture phase, so that no field or menu can block the Stop key.
    addEventListener("keydown", press, { capture: true });
    document.addEventListener("visibilitychange", visibility);
    addEventListener("blur", blur);
    addEventListener("pagehide", leave);
    return () => {
      removeEventListener("keydown", press, { capture: true });
      document.removeEventListener("visibilitychange", visibility);
      removeEventListener("blur", blur);
      removeEventListener("pagehide", leave);
      for (const session of made) session.dispose();
      setStations([]);
    };
    // Devices change only with their ids.
  }, [api, fleet, ids, account]);

  return sessions;
}
