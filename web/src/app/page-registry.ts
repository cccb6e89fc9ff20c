/**
 * All pages: address, title, navigation entry and lazily loaded code. Routing, navigation and loading use only this
 * table. All pages require a signed-in account: without one, the app shows the sign-in page for every address.
 */
import type { Account } from "../shared/api/types";
import type { ComponentType } from "preact";
import type { Api } from "../shared/api/client";
import type { Fleet } from "../features/devices/model/device-list";
import type { FollowedInvitation } from "../features/sharing/model/invitation-link";
import type { FollowedCode } from "../features/pairing/model/claim-code";
import type { RouteParameters, PageName } from "../shared/routing/routes";
import { texts } from "./texts";

/** Properties of every page. */
export interface PageProps extends RouteParameters {
  api: Api;
  fleet: Fleet;
  account: Account;
  followed: FollowedInvitation;
  pairing: FollowedCode;
}

type Loaded = Promise<ComponentType<PageProps>>;
type Part = "account" | "administration" | "devices" | "health" | "movements" | "robotTypes" | "latency" | "timeline";

interface Page {
  readonly title: string | ((at: RouteParameters, fleet: Fleet) => string);
  /** The section of the console that contains the page. */
  readonly part: Part;
  /** The navigation link; one page per section has one. */
  readonly link?: string;
  /** Whether the code is preloaded. */
  readonly early?: true;
  readonly load: () => Loaded;
}

const device = (id: string, fleet: Fleet): string => fleet.devices.value?.get(id)?.info.value.label ?? texts.sections.devices;
const health = async (): Loaded => (await import("../features/health/list-page")).HealthPage;
const latency = async (): Loaded => (await import("../features/latency/page")).LatencyPage;

export const PAGES = {
  devices: {
    title: texts.sections.devices,
    part: "devices",
    link: texts.sections.devices,
    early: true,
    load: async (): Loaded => (await import("./pages/device-list-page")).DeviceListPage,
  },
  device: {
    title: ({ id }: RouteParameters, fleet: Fleet): string => device(id, fleet),
    part: "devices",
    early: true,
    load: async (): Loaded => (await import("./pages/robot-page")).DevicePage,
  },
  keyframes: {
    title: texts.pages.keyframes,
    part: "devices",
    load: async (): Loaded => (await import("../features/keyframes/device-page")).KeyframesPage,
  },
  multiRobot: {
    title: ({ ids }: RouteParameters): string => texts.pages.multiRobot(ids.split(",").length),
    part: "devices",
    load: async (): Loaded => (await import("../features/steering/multi-robot/page")).MultiRobotPage,
  },
  space: {
    title: ({ id }: RouteParameters, fleet: Fleet): string => fleet.spaceName(id),
    part: "devices",
    early: true,
    load: async (): Loaded => (await import("../features/spaces/detail-page")).SpacePage,
  },
  pair: {
    title: texts.pages.pair,
    part: "devices",
    load: async (): Loaded => (await import("../features/pairing/page")).PairingPage,
  },
  movements: {
    title: texts.sections.movements,
    part: "movements",
    link: texts.sections.movements,
    load: async (): Loaded => (await import("../features/movements/library-page")).LibraryPage,
  },
  movement: {
    title: ({ name }: RouteParameters): string => name,
    part: "movements",
    load: async (): Loaded => (await import("../features/movements/editor-page")).EditorPage,
  },
  tasks: {
    title: ({ robotType }: RouteParameters): string => texts.pages.tasksOf(robotType.replaceAll("_", " ")),
    part: "robotTypes",
    load: async (): Loaded => (await import("../features/autonomy/tasks/list-page")).TaskListPage,
  },
  task: {
    title: ({ name }: RouteParameters): string => name.replaceAll("_", " "),
    part: "robotTypes",
    load: async (): Loaded => (await import("../features/autonomy/tasks/page")).TaskPage,
  },
  typeKeyframes: {
    title: texts.pages.keyframes,
    part: "movements",
    load: async (): Loaded => (await import("../features/keyframes/robot-type-page")).TypeKeyframesPage,
  },
  robotTypes: {
    title: texts.sections.robotTypes,
    part: "robotTypes",
    link: texts.sections.robotTypes,
    load: async (): Loaded => (await import("../features/robot-types/list-page")).RobotTypesPage,
  },
  robotType: {
    title: ({ id }: RouteParameters): string => id.replaceAll("_", " "),
    part: "robotTypes",
    load: async (): Loaded => (await import("../features/robot-types/detail-page")).RobotTypePage,
  },
  addRobotType: {
    title: texts.pages.addRobotType,
    part: "robotTypes",
    load: async (): Loaded => (await import("../features/robot-types/add-page")).AddRobotTypePage,
  },
  health: { title: texts.sections.health, part: "health", link: texts.sections.health, load: health },
  deviceHealth: {
    title: (at: RouteParameters, fleet: Fleet): string => texts.pages.healthOf(device(at.device, fleet)),
    part: "health",
    load: health,
  },
  spaceHealth: {
    title: ({ space }: RouteParameters, fleet: Fleet): string => texts.pages.healthOf(fleet.spaceName(space)),
    part: "health",
    load: health,
  },
  latency: { title: texts.sections.latency, part: "latency", link: texts.sections.latency, load: latency },
  deviceLatency: {
    title: (at: RouteParameters, fleet: Fleet): string => texts.pages.latencyOf(device(at.device, fleet)),
    part: "latency",
    load: latency,
  },
  deviceAutonomy: {
    title: (at: RouteParameters, fleet: Fleet): string => texts.pages.autonomyOf(device(at.device, fleet)),
    part: "devices",
    load: async (): Loaded => (await import("../features/autonomy/page")).AutonomyPage,
  },
  timeline: {
    title: texts.sections.timeline,
    part: "timeline",
    link: texts.sections.timeline,
    load: async (): Loaded => (await import("../features/autonomy/fleet-timeline/page")).FleetTimelinePage,
  },
  session: {
    title: (at: RouteParameters, fleet: Fleet): string => texts.pages.sessionOf(device(at.device, fleet)),
    part: "devices",
    load: async (): Loaded => (await import("../features/autonomy/recording/page")).SessionPage,
  },
  administration: {
    title: texts.sections.administration,
    part: "administration",
    link: texts.sections.administration,
    load: async (): Loaded => (await import("../features/health/administration/page")).AdministrationPage,
  },
  account: {
    title: texts.pages.account,
    part: "account",
    load: async (): Loaded => (await import("../features/account/page")).AccountPage,
  },
  auditLog: {
    title: texts.pages.audit,
    part: "account",
    load: async (): Loaded => (await import("../features/account/audit-page")).AuditLogPage,
  },
  invitation: {
    title: texts.pages.invitation,
    part: "account",
    load: async (): Loaded => (await import("../features/sharing/invitation-page")).InvitationPage,
  },
} satisfies Record<PageName, Page>;

/** The table with the general row type instead of the literal types. */
export const ROWS: ReadonlyMap<PageName, Page> = new Map(Object.entries(PAGES) as [PageName, Page][]);
