/**
 * Every page there is: its address, what it is called, where it stands in the navigation, and the code that comes when it
 * is opened. Routing, navigation and loading go by this table alone. All pages are for who is signed in: to anybody
 * else the app shows the sign-in, whatever the address.
 */
import type { ComponentType } from "preact";
import type { Account, Api } from "../shared/api/client";
import type { Fleet } from "../features/devices/model/device-list";
import type { FollowedInvitation } from "../features/sharing/model/invitation-link";
import type { FollowedCode } from "../features/pairing/model/claim-code";
import { texts } from "./texts";

/** What addresses name; empty where a page's address does not. */
export type At = Readonly<Record<"device" | "id" | "ids" | "name" | "robotType" | "space", string>>;

/** What a page is given; each takes of it what it needs. */
export interface PageProps extends At {
  api: Api;
  fleet: Fleet;
  account: Account;
  followed: FollowedInvitation;
  pairing: FollowedCode;
}

type Loaded = Promise<ComponentType<PageProps>>;
type Part = "account" | "fleet" | "health" | "movements" | "robotTypes" | "times";

interface Page {
  /** `:name` is a part that is filled in, `:name?` one that may be left out with the slash before it. */
  readonly pattern: `#/${string}`;
  readonly title: string | ((at: At, fleet: Fleet) => string);
  /** Which part of the console it belongs to. */
  readonly part: Part;
  /** Its link in the navigation, of one page of each part. */
  readonly link?: string;
  /** Its code is fetched with the first load: who operates must not have to wait for it. */
  readonly early?: true;
  readonly load: () => Loaded;
}

const device = (id: string, fleet: Fleet): string => fleet.devices.value?.get(id)?.info.value.label ?? texts.sections.devices;
const health = async (): Loaded => (await import("../features/health/list-page")).HealthPage;
const times = async (): Loaded => (await import("../features/latency/page")).LatencyPage;

export const PAGES = {
  fleet: {
    pattern: "#/",
    title: texts.sections.devices,
    part: "fleet",
    link: texts.sections.devices,
    early: true,
    load: async (): Loaded => (await import("../features/devices/list-page")).DeviceListPage,
  },
  device: {
    pattern: "#/devices/:id",
    title: ({ id }: At, fleet: Fleet): string => device(id, fleet),
    part: "fleet",
    early: true,
    load: async (): Loaded => (await import("../features/devices/robot-page")).DevicePage,
  },
  keyframes: {
    pattern: "#/devices/:id/keyframes/:name?",
    title: texts.pages.keyframes,
    part: "fleet",
    load: async (): Loaded => (await import("../features/keyframes/device-page")).KeyframesPage,
  },
  together: {
    pattern: "#/operate/:ids",
    title: ({ ids }: At): string => texts.pages.multiRobot(ids.split(",").length),
    part: "fleet",
    load: async (): Loaded => (await import("../features/steering/multi-robot-page")).MultiRobotPage,
  },
  space: {
    pattern: "#/spaces/:id",
    title: ({ id }: At, fleet: Fleet): string => fleet.spaceName(id),
    part: "fleet",
    early: true,
    load: async (): Loaded => (await import("../features/spaces/detail-page")).SpacePage,
  },
  pair: {
    pattern: "#/pair",
    title: texts.pages.pair,
    part: "fleet",
    load: async (): Loaded => (await import("../features/pairing/page")).PairingPage,
  },
  movements: {
    pattern: "#/movements",
    title: texts.sections.movements,
    part: "movements",
    link: texts.sections.movements,
    load: async (): Loaded => (await import("../features/movements/library-page")).LibraryPage,
  },
  movement: {
    pattern: "#/movements/:robotType/:name",
    title: ({ name }: At): string => name,
    part: "movements",
    load: async (): Loaded => (await import("../features/movements/editor-page")).EditorPage,
  },
  typeKeyframes: {
    pattern: "#/robot-types/:robotType/keyframes/:name?",
    title: texts.pages.keyframes,
    part: "movements",
    load: async (): Loaded => (await import("../features/keyframes/robot-type-page")).TypeKeyframesPage,
  },
  robotTypes: {
    pattern: "#/robot-types",
    title: texts.sections.robotTypes,
    part: "robotTypes",
    link: texts.sections.robotTypes,
    load: async (): Loaded => (await import("../features/robot-types/list-page")).RobotTypesPage,
  },
  robotType: {
    pattern: "#/robot-types/:id",
    title: ({ id }: At): string => id.replaceAll("_", " "),
    part: "robotTypes",
    load: async (): Loaded => (await import("../features/robot-types/detail-page")).RobotTypePage,
  },
  addRobotType: {
    pattern: "#/add-robot-type",
    title: texts.pages.addRobotType,
    part: "robotTypes",
    load: async (): Loaded => (await import("../features/robot-types/add-page")).AddRobotTypePage,
  },
  health: { pattern: "#/health", title: texts.sections.health, part: "health", link: texts.sections.health, load: health },
  deviceHealth: {
    pattern: "#/devices/:device/health",
    title: (at: At, fleet: Fleet): string => texts.pages.healthOf(device(at.device, fleet)),
    part: "health",
    load: health,
  },
  spaceHealth: {
    pattern: "#/spaces/:space/health",
    title: ({ space }: At, fleet: Fleet): string => texts.pages.healthOf(fleet.spaceName(space)),
    part: "health",
    load: health,
  },
  times: { pattern: "#/times", title: texts.sections.latency, part: "times", link: texts.sections.latency, load: times },
  deviceTimes: {
    pattern: "#/devices/:device/times",
    title: (at: At, fleet: Fleet): string => texts.pages.latencyOf(device(at.device, fleet)),
    part: "times",
    load: times,
  },
  account: {
    pattern: "#/account",
    title: texts.pages.account,
    part: "account",
    load: async (): Loaded => (await import("../features/account/page")).AccountPage,
  },
  activity: {
    pattern: "#/account/activity",
    title: texts.pages.audit,
    part: "account",
    load: async (): Loaded => (await import("../features/account/audit-page")).AuditLogPage,
  },
  invitation: {
    pattern: "#/invitation",
    title: texts.pages.invitation,
    part: "account",
    load: async (): Loaded => (await import("../features/sharing/invitation-page")).InvitationPage,
  },
} satisfies Record<string, Page>;

export type PageName = keyof typeof PAGES;

/** Typed by what each row may have, not by what it has. */
export const ROWS: ReadonlyMap<PageName, Page> = new Map(Object.entries(PAGES) as [PageName, Page][]);
