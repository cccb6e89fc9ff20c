/** Where the page is, in the address's fragment, which the server never sees; and the addresses of all pages. */
import { signal, type ReadonlySignal } from "@preact/signals";
import { type At, type PageName, PAGES, ROWS } from "./page-registry";

export interface Route {
  page: PageName;
  at: At;
}

const NOTHING: At = { device: "", id: "", ids: "", name: "", robotType: "", space: "" };

const EXPRESSIONS: readonly (readonly [PageName, RegExp])[] = [...ROWS].map(([name, { pattern }]) => [
  name,
  new RegExp(
    `^${pattern
      .replaceAll(/\/:(\w+)\?/g, "(?:/(?<$1>[A-Za-z0-9_,-]+))?")
      .replaceAll(/\/:(\w+)/g, "/(?<$1>[A-Za-z0-9_,-]+)")}$`,
  ),
]);

/** The page of an address; the first one's where there is no such page. */
export function read(hash: string): Route {
  for (const [page, expression] of EXPRESSIONS) {
    const found = expression.exec(hash);
    if (found === null) continue;
    const named = Object.entries(found.groups ?? {}).filter(([, value]) => (value as string | undefined) !== undefined);
    return { page, at: { ...NOTHING, ...Object.fromEntries(named) } };
  }
  return { page: "fleet", at: NOTHING };
}

/** The address of a page, with what its pattern names. */
function address(page: PageName, at: Partial<At> = {}): string {
  return PAGES[page].pattern.replaceAll(/\/:(\w+)\??/g, (_, name: keyof At) => (at[name] ? `/${at[name]}` : ""));
}

const current = signal(read(location.hash));
export const route: ReadonlySignal<Route> = current;

export const accountAddress = address("account");
export const auditLogAddress = address("activity");
export const addRobotTypeAddress = address("addRobotType");
export const deviceListAddress = address("fleet");
export const healthAddress = address("health");
export const invitationAddress = address("invitation");
export const movementsAddress = address("movements");
export const pairAddress = address("pair");
export const robotTypesAddress = address("robotTypes");

export function deviceAddress(id: string): string {
  return address("device", { id });
}

/** The keyframe editor on a device; without a name a new movement. */
export function keyframesAddress(device: string, name = ""): string {
  return address("keyframes", { id: device, name });
}

/** The same for all robots of a type, without a device. */
export function typeKeyframesAddress(robotType: string, name = ""): string {
  return address("typeKeyframes", { robotType, name });
}

export function spaceAddress(id: string): string {
  return address("space", { id });
}

/** Several devices on one page. */
export function multiRobotAddress(ids: readonly string[]): string {
  return address("together", { ids: ids.join(",") });
}

export function robotTypeAddress(id: string): string {
  return address("robotType", { id });
}

export function healthAddressOf(kind: "device" | "space", id: string): string {
  return kind === "device" ? address("deviceHealth", { device: id }) : address("spaceHealth", { space: id });
}

export function latencyAddressOf(device: string): string {
  return address("deviceTimes", { device });
}

export function movementAddress(robotType: string, name: string): string {
  return address("movement", { robotType, name });
}

/** Go to a page in the place of this one: the way back does not lead here again. */
export function replaceWith(to: string): void {
  location.replace(to);
}

addEventListener("hashchange", () => (current.value = read(location.hash)));
