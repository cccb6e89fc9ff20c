import type { Reach } from "./model/device-store";

export const texts = {
  reach: { online: "Online", stale: "Stale", offline: "Offline", unknown: "Unknown" } satisfies Record<Reach, string>,
  reachExplained: {
    online: "The device is connected and its data is current.",
    stale: "The device is connected, but its data is overdue.",
    offline: "The device's agent is not connected.",
    unknown: "This page has no connection to the broker, so the status is unknown.",
  } satisfies Record<Reach, string>,

  list: {
    title: "Devices",
    none: "No devices. Pair one with the code that its agent shows.",
    device: "Device",
    status: "Status",
    lastSeen: "Last seen",
    activity: "Activity",
    control: "Controlled by",
    noOperator: "–",
    you: "you",
    fault: (message: string): string => (message === "" ? "Fault" : `Fault: ${message}`),
    faults: (count: number): string => (count === 1 ? "1 fault" : `${count} faults`),
    running: (name: string): string => `Running: ${name}`,
    pair: "Pair a device",
    search: "Search",
    searchExample: "Name, type or room",
    show: "Show",
    kinds: { all: "All", robots: "Robots", sensors: "Room devices" },
    owner: "Owner",
    owners: { all: "All", mine: "Mine", shared: "Shared with me" },
    needsAttention: "Needs attention",
    shown: (shown: number, all: number): string => (shown === all ? `${all} devices` : `${shown} of ${all} devices`),
    noMatch: "No devices match the filters.",
    clear: "Clear filters",
    robots: "Robots",
    sensors: "Room devices",
    plan: "Floor plan",
    planOf: (space: string): string => `Floor plan of ${space}`,
  },

  naming: {
    rename: "Rename",
    renameOf: (label: string): string => `Rename ${label}`,
    name: "Name",
    save: "Save",
    saving: "Saving…",
    cancel: "Cancel",
    renamed: (label: string): string => `Renamed to ${label}.`,
    undo: "Undo",
  },

  consent: {
    explained:
      "With the owner's consent, pictures of these cameras are stored with recorded sessions: on the disk of the agent's computer, and in the cloud. Everyone with access to the device can see them there. The people in the room must agree.",
    recordedNow: "being recorded now",
    allowed: "recorded in sessions",
    forbidden: "not recorded",
    allow: "Allow recording",
    allowOf: (camera: string): string => `Allow recording of ${camera}`,
    question: "Do the people in the room agree?",
    saving: "Saving…",
    withdraw: "Stop recording",
    never: "The owner has not decided.",
    decided: (name: string): string => `Decided by ${name}. Deleting a session's recording deletes its pictures.`,
    ownerOnly: "Only the owner can change this.",
    unconfirmed: "The device has not confirmed this yet. It receives the decision when it is connected.",
    rejected: (reason: string): string => `The device rejected this: ${reason}.`,
    camerasOf: (label: string, cameras: string): string => `${label} (${cameras})`,
    inRoom: (names: string): string => `Cameras are being recorded in this room: ${names}.`,
  },

  device: {
    accessLost: (label: string): string => `You no longer have access to ${label}.`,
    accessLostReason:
      "The owner revoked your access, it expired, or the device was unpaired. Your control and actions ended immediately. Ask the owner if you need access again.",
    simulated: "simulated",
    overloaded: (rates: string): string => `The device's computer is overloaded. Reduced rates: ${rates}. Control is not affected.`,
    rate: (name: string, measured: string, configured: string): string => `${name} ${measured} of ${configured} Hz`,
    unreadable: (detail: string): string => `A message of this device is invalid: ${detail}.`,
    lastSeen: (age: string): string => `last seen ${age}`,
  },

  /** Selection of robots that are operated on one page. */
  selection: {
    add: (label: string): string => `Select ${label} to operate several robots`,
    count: (count: number): string => (count === 1 ? "1 robot selected. Select another one." : `${count} robots selected.`),
    open: "Operate selected",
    clear: "Clear selection",
  },

  /** Why a device cannot be operated now. */
  unavailable: {
    viewer: "You are a viewer of this device. Ask its owner for operator access.",
    offline: "The device is not connected.",
    stopped: "The device is stopped. Reset the stop first.",
    busy: "Another action is running. Cancel it first.",
    held: (name: string): string => `${name} has control.`,
    fault: "The robot reports a fault.",
    streaming: "The robot is following your setpoints.",
  },

  cards: {
    view: "Live view",
    camera: "Camera",
    consent: "Recording of cameras",
    plot: "Last 20 seconds",
    poses: "Joint frames",
    steering: "Steering",
    latency: "Latency",
    settings: "Settings",
    movements: "Movements",
    keyframes: "Keyframes",
    access: "Access",
    events: "Events",
  },
  events: { none: "No events.", faults: "Faults" },

  pages: {
    device: "Device",
    health: "Health",
    latency: "Latency",
    autonomy: "Autonomy",
    of: (label: string): string => `Pages of ${label}`,
    title: {
      health: (name: string): string => `Health of ${name}`,
      latency: (name: string): string => `Latency of ${name}`,
      autonomy: (name: string): string => `Autonomy of ${name}`,
      session: (name: string): string => `Recorded session of ${name}`,
    },
  },
};
