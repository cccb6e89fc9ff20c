/** The devices that are operated on a page, from its opening to its end. */
import type { Account } from "../../shared/api/types";
import { useEffect, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import type { DeviceStore } from "./model/device-store";
import type { Fleet } from "./model/device-list";
import { DeviceSession } from "./model/device-session";

/** One session for each device, in their order; none before the page is there. One key stops them all. */
export function useDeviceSessions(
  api: Api,
  fleet: Fleet,
  devices: readonly DeviceStore[],
  account: Account,
): readonly DeviceSession[] {
  const [sessions, setStations] = useState<readonly DeviceSession[]>([]);
  const ids = devices.map(({ id }) => id).join(" ");

  useEffect(() => {
    // Without a device the key is anybody's.
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
      for (const { control } of made) control.streamer.value?.letGo();
    };
    const leave = (): void => {
      for (const { control, watchers: watching } of made) {
        void control.release(true);
        watching.seen(false);
      }
    };
    // In the capture phase: no field or menu may keep the key from stopping a robot.
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
    // Devices are the same as long as their ids are.
  }, [api, fleet, ids, account]);

  return sessions;
}
