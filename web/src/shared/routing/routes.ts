/** The current route, stored in the URL fragment, which is not sent to the server; and all page addresses. */
import { signal, type ReadonlySignal } from "@preact/signals";

/** Route parameters; empty if the address lacks the parameter. */
export type RouteParameters = Readonly<Record<"device" | "epoch" | "id" | "ids" | "name" | "other" | "robotType" | "space", string>>;

/** The address of each page: `:name` is a parameter, `:name?` an optional one. */
const PATTERNS = {
  devices: "#/",
  device: "#/devices/:id",
  keyframes: "#/devices/:id/keyframes/:name?",
  multiRobot: "#/operate/:ids",
  space: "#/spaces/:id",
  pair: "#/pair",
  movements: "#/movements",
  movement: "#/movements/:robotType/:name",
  tasks: "#/tasks/:robotType",
  task: "#/tasks/:robotType/:name",
  typeKeyframes: "#/robot-types/:robotType/keyframes/:name?",
  robotTypes: "#/robot-types",
  robotType: "#/robot-types/:id",
  addRobotType: "#/add-robot-type",
  health: "#/health",
  deviceHealth: "#/devices/:device/health",
  spaceHealth: "#/spaces/:space/health",
  latency: "#/latency",
  deviceLatency: "#/devices/:device/latency",
  deviceAutonomy: "#/devices/:device/autonomy",
  timeline: "#/timeline",
  session: "#/devices/:device/sessions/:epoch/:other?",
  account: "#/account",
  auditLog: "#/account/audit-log",
  administration: "#/administration",
  invitation: "#/invitation",
} as const;

export type PageName = keyof typeof PATTERNS;

interface Route {
  page: PageName;
  at: RouteParameters;
}

const NO_PARAMETERS: RouteParameters = { device: "", epoch: "", id: "", ids: "", name: "", other: "", robotType: "", space: "" };

const EXPRESSIONS: readonly (readonly [PageName, RegExp])[] = (Object.entries(PATTERNS) as [PageName, string][]).map(([name, pattern]) => [
  name,
  new RegExp(
    `^${pattern
      .replaceAll(/\/:(\w+)\?/g, "(?:/(?<$1>[A-Za-z0-9_,-]+))?")
      .replaceAll(/\/:(\w+)/g, "/(?<$1>[A-Za-z0-9_,-]+)")}$`,
  ),
]);

/** The page of an address; the first page if none matches. */
export function read(hash: string): Route {
  for (const [page, expression] of EXPRESSIONS) {
    const found = expression.exec(hash);
    if (found === null) continue;
    const named = Object.entries(found.groups ?? {}).filter(([, value]) => (value as string | undefined) !== undefined);
    return { page, at: { ...NO_PARAMETERS, ...Object.fromEntries(named) } };
  }
  return { page: "devices", at: NO_PARAMETERS };
}

/** The address of a page with its parameters. */
export function pageAddress(page: PageName, at: Partial<RouteParameters> = {}): string {
  return PATTERNS[page].replaceAll(/\/:(\w+)\??/g, (_, name: keyof RouteParameters) => (at[name] ? `/${at[name]}` : ""));
}

const current = signal(read(location.hash));
export const route: ReadonlySignal<Route> = current;

export const accountAddress = pageAddress("account");
export const auditLogAddress = pageAddress("auditLog");
export const addRobotTypeAddress = pageAddress("addRobotType");
export const deviceListAddress = pageAddress("devices");
export const healthAddress = pageAddress("health");
export const invitationAddress = pageAddress("invitation");
export const movementsAddress = pageAddress("movements");
export const pairAddress = pageAddress("pair");
export const robotTypesAddress = pageAddress("robotTypes");

export function deviceAddress(id: string): string {
  return pageAddress("device", { id });
}

/** The keyframe editor of a device; without a name, a new movement. */
export function keyframesAddress(device: string, name = ""): string {
  return pageAddress("keyframes", { id: device, name });
}

/** The keyframe editor of a robot type, without a device. */
export function typeKeyframesAddress(robotType: string, name = ""): string {
  return pageAddress("typeKeyframes", { robotType, name });
}

export function spaceAddress(id: string): string {
  return pageAddress("space", { id });
}

/** Several devices on one page. */
export function multiRobotAddress(ids: readonly string[]): string {
  return pageAddress("multiRobot", { ids: ids.join(",") });
}

export function robotTypeAddress(id: string): string {
  return pageAddress("robotType", { id });
}

/** The tasks of a robot type. */
export function tasksAddress(robotType: string): string {
  return pageAddress("tasks", { robotType });
}

/** One task with its trials. */
export function taskAddress(robotType: string, name: string): string {
  return pageAddress("task", { robotType, name });
}

export function healthAddressOf(kind: "device" | "space", id: string): string {
  return kind === "device" ? pageAddress("deviceHealth", { device: id }) : pageAddress("spaceHealth", { space: id });
}

export function latencyAddressOf(device: string): string {
  return pageAddress("deviceLatency", { device });
}

export function autonomyAddressOf(device: string): string {
  return pageAddress("deviceAutonomy", { device });
}

/** The recording of one session of a device. `other`: the session to compare it with, as `selectionText` writes it. */
export function sessionAddress(device: string, epoch: number, other = ""): string {
  return pageAddress("session", { device, epoch: String(epoch), other });
}

export function movementAddress(robotType: string, name: string): string {
  return pageAddress("movement", { robotType, name });
}

/** Replaces the current history entry with another page. */
export function replaceWith(to: string): void {
  location.replace(to);
}

addEventListener("hashchange", () => (current.value = read(location.hash)));
