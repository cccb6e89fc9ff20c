/** Where the page is: in the address's fragment, which the server never sees. */
import { signal, type ReadonlySignal } from "@preact/signals";

export type Route =
  | { page: "fleet" | "account" | "activity" | "invitation" | "movements" | "pair" }
  | { page: "movement"; robotType: string; name: string }
  | { page: "keyframes"; id: string; name: string }
  | { page: "device" | "space"; id: string }
  | { page: "together"; ids: readonly string[] }
  | { page: "robot-types" | "add-robot-type" }
  | { page: "robot-type"; id: string }
  | { page: "health" | "times"; device: string; space: string };

export const accountAddress = "#/account";
export const activityAddress = "#/account/activity";
export const invitationAddress = "#/invitation";
export const robotTypesAddress = "#/robot-types";
export const addRobotTypeAddress = "#/add-robot-type";
export const movementsAddress = "#/movements";
export const pairAddress = "#/pair";

/** Of all devices, of one, or of one space's. */
const KEPT = /^#\/(?:(device|space)s\/([A-Za-z0-9_-]+)\/)?(health|times)$/;

const NAMED: Readonly<Record<string, Route>> = {
  [accountAddress]: { page: "account" },
  [activityAddress]: { page: "activity" },
  [invitationAddress]: { page: "invitation" },
  [robotTypesAddress]: { page: "robot-types" },
  [addRobotTypeAddress]: { page: "add-robot-type" },
  [movementsAddress]: { page: "movements" },
  [pairAddress]: { page: "pair" },
};

function read(): Route {
  const keyframes = /^#\/devices\/([A-Za-z0-9_-]+)\/keyframes(?:\/([A-Za-z0-9_-]+))?$/.exec(location.hash);
  if (keyframes?.[1] !== undefined) return { page: "keyframes", id: keyframes[1], name: keyframes[2] ?? "" };
  const found = /^#\/(device|space|robot-type)s\/([A-Za-z0-9_-]+)$/.exec(location.hash);
  if (found?.[2] !== undefined) return { page: found[1] as "device" | "space" | "robot-type", id: found[2] };
  const several = /^#\/operate\/([A-Za-z0-9_-]+(?:,[A-Za-z0-9_-]+)*)$/.exec(location.hash)?.[1];
  if (several !== undefined) return { page: "together", ids: [...new Set(several.split(","))] };
  const kept = KEPT.exec(location.hash);
  if (kept !== null) {
    const [, kind, id = "", page] = kept;
    return { page: page === "times" ? "times" : "health", device: kind === "device" ? id : "", space: kind === "space" ? id : "" };
  }
  const movement = /^#\/movements\/([A-Za-z0-9_-]+)\/([A-Za-z0-9_-]+)$/.exec(location.hash);
  if (movement?.[1] !== undefined && movement[2] !== undefined) {
    return { page: "movement", robotType: movement[1], name: movement[2] };
  }
  return NAMED[location.hash] ?? { page: "fleet" };
}

const current = signal(read());
export const route: ReadonlySignal<Route> = current;

export const fleetAddress = "#/";

export const healthAddress = "#/health";
export const timesAddress = "#/times";

export function deviceAddress(id: string): string {
  return `#/devices/${id}`;
}

/** The keyframe editor on a device; without a name a new movement. */
export function keyframesAddress(device: string, name = ""): string {
  return `${deviceAddress(device)}/keyframes${name === "" ? "" : `/${name}`}`;
}

export function spaceAddress(id: string): string {
  return `#/spaces/${id}`;
}

/** Several devices on one page. */
export function togetherAddress(ids: readonly string[]): string {
  return `#/operate/${ids.join(",")}`;
}

export function robotTypeAddress(type: string): string {
  return `#/robot-types/${type}`;
}

export function healthAddressOf(kind: "device" | "space", id: string): string {
  return `#/${kind}s/${id}/health`;
}

export function timesAddressOf(device: string): string {
  return `#/devices/${device}/times`;
}

export function movementAddress(robotType: string, name: string): string {
  return `${movementsAddress}/${robotType}/${name}`;
}

/** Go to a page in the place of this one: the way back does not lead here again. */
export function replaceWith(address: string): void {
  location.replace(address);
}

addEventListener("hashchange", () => (current.value = read()));
