/** Every word that the page says, in one place, so that it can be said in another language. */
import type { RunStatus } from "./core/action";
import type { Reach } from "./core/device";
import type { Quantity } from "./core/history";
import type { Mode } from "./core/protocol";
import type { EndedBecause } from "./core/streamer";

const oneDigit = new Intl.NumberFormat("en", { minimumFractionDigits: 1, maximumFractionDigits: 1, useGrouping: false });

export const texts = {
  product: "Telescope",
  loading: "Loading …",
  skipToContent: "Skip to the content",

  number: {
    oneDigit: (value: number): string => oneDigit.format(Object.is(Math.round(value * 10), -0) ? 0 : value),
    degrees: (value: number): string => `${texts.number.oneDigit(value)}°`,
    wholeDegrees: (value: number): string => `${Math.round(value)}°`,
    milliseconds: (value: number): string => (value < 10 ? `${texts.number.oneDigit(value)} ms` : `${Math.round(value)} ms`),
    unknown: "–",
  },

  age: (ms: number): string => {
    const s = ms / 1000;
    if (s < 2) return "just now";
    if (s < 60) return `${Math.floor(s)} s ago`;
    if (s < 3600) return `${Math.floor(s / 60)} min ago`;
    if (s < 48 * 3600) return `${Math.floor(s / 3600)} h ago`;
    return `${Math.floor(s / 86400)} days ago`;
  },

  session: {
    checking: "Finding out who you are …",
    title: "Sign in",
    failed: "That did not work",
    name: "Name",
    password: "Password",
    enter: "Sign in",
    elsewhere: (name: string): string => `Sign in with ${name}`,
    elsewhereExpired: "That took too long, or was begun in another browser. Begin again.",
    elsewhereRefused: "You were not signed in there. Try again, or ask whoever runs this server.",
    byLink: "With a sign-in link",
    explain: "Each link works once. A new account has no password yet: come in by its link, and set one under your name.",
    where:
      "The program that runs this server prints one when it starts: look in its terminal for the line that begins with “ready”. For another one, run this there:",
    command: "make link",
    pasted: "Or paste the link here",
    use: "Sign in",
    notALink: "This is not a sign-in link: it has “#sign-in=” and a token in it.",
    out: "Sign out",
    ended: "Your sign-in has ended. Sign in again to go on.",
    signedInAs: (name: string): string => `Signed in as ${name}`,
  },

  account: {
    title: "Your account",
    password: "Password",
    passwordExplained:
      "At least twelve characters; a sentence of a few words is a good one. Every other sign-in of yours ends. Within ten minutes of opening a sign-in link the old one may be left empty.",
    old: "Old password",
    new: "New password",
    change: "Set password",
    changed: "The password is set.",
    sessions: "Where you are signed in",
    session: (how: string, since: string): string => `By ${how}, since ${since}`,
    how: { link: "link", password: "password", "open-id": "your provider" },
    this: "this one",
    end: "End",
    endOthers: "End all others",
  },

  link: {
    down: "No connection to the broker. What you see is the last that was heard; nothing on this page is live.",
    again: "Connecting again …",
    refused: "The broker connection was refused.",
    retry: "Try again",
    list: "The list of devices could not be read:",
  },

  reach: { online: "Online", stale: "Stale", offline: "Offline", unknown: "Unknown" } satisfies Record<Reach, string>,
  reachExplained: {
    online: "The device is connected and its data is fresh.",
    stale: "The device counts as connected, but nothing has come from it for too long.",
    offline: "The device's agent is not connected.",
    unknown: "This page has no connection to the broker, so it cannot say.",
  } satisfies Record<Reach, string>,

  mode: {
    idle: "at rest",
    streaming: "following an operator",
    action: "running a movement",
    holding: "holding",
    stopped: "stopped",
    fault: "fault",
  } satisfies Record<Mode, string>,

  fleet: {
    title: "Devices",
    none: "No device yet. Pair one with the code that its agent shows.",
    device: "Device",
    status: "Status",
    heard: "Last word",
    doing: "Doing",
    control: "In control",
    nobody: "nobody",
    you: "you",
    never: "never",
    faults: (count: number): string => (count === 1 ? "1 fault" : `${count} faults`),
  },

  pair: {
    title: "Pair a device",
    explain: "Type the code that the agent shows when it starts. It is valid for five minutes.",
    code: "Claim code",
    example: "BCDF-GHJK",
    submit: "Pair",
    busy: "Pairing …",
    malformed: "A claim code has eight letters, such as BCDF-GHJK.",
    done: (labels: string): string => `Paired: ${labels}.`,
  },

  device: {
    back: "All devices",
    missing: "There is no such device, or you may not see it.",
    simulated: "simulated",
    unreadable: (what: string): string => `A message of this device could not be read: ${what}.`,
    still:
      "This device has no joints. What it measures, and what can be asked of it, is reached over HTTP and MQTT; " +
      "here are its state, its Stop and its events.",
    lastWord: (age: string): string => `last word ${age}`,
  },

  control: {
    title: "Control",
    take: "Take control",
    resume: "Resume control",
    release: "Release control",
    taking: "Taking control …",
    mine: "You have control",
    unconfirmed: "You have control; the robot has not confirmed it yet",
    free: "Nobody has control",
    watches: "You may watch this device, not operate it. Ask its owner.",
    other: (holder: string): string => `${holder} has control`,
    elsewhere: "This sign-in has control in another tab",
    lost: (why: string): string => `Control lost: ${why}`,
    refused: (why: string): string => `Control was not given: ${why}`,
    needsDescription: "The robot has not described itself yet.",
    noWay: "The connection for setpoints is being made …",
  },

  stop: {
    press: "Stop",
    key: "Esc",
    keyExplained: "The Escape key stops the robot, wherever the focus is.",
    sending: "Stop sent. Waiting for the robot to confirm …",
    doubtful: "Stop sent, but the robot has not confirmed it. It is sent again and again. If you can, use the stop button at the robot.",
    unconfirmed: "The robot never confirmed the stop. Go to the robot, or have somebody go.",
    latched: "Stopped",
    by: (by: string, reason: string): string => (reason === "" ? `by ${by}` : `by ${by}: ${reason}`),
    explain: "The robot stays stopped until the stop is reset. Nothing resumes by itself.",
    reset: "Reset stop",
    confirmQuestion: "Is everybody clear of the robot?",
    confirm: "Yes, reset",
    keep: "Keep stopped",
    resetting: "Resetting …",
  },

  joints: {
    title: "Joints",
    target: (label: string): string => `${label}: target in degrees`,
    slider: (label: string): string => `${label}: target`,
    measured: (label: string): string => `${label}: measured`,
    heading: { joint: "Joint", target: "Target", measured: "Measured" },
    unit: "°",
    keys: "Arrow keys move by 1°, with Shift by 10°, with Alt by 0.1°. Type a number and press Enter to go there.",
    takeFirst: "Take control to move the joints.",
    waiting: "Waiting for the robot …",
    streaming: "Sending targets",
    busy: "A movement is running.",
    stopped: "The robot is stopped.",
    limited: (what: string): string => `Limited by the robot: ${what}`,
    noDescription: "Waiting for the robot's description …",
    ended: {
      reached: "Target reached",
      stuck: "The robot stopped short of the target",
      stopped: "Ended: the robot is stopped",
      hidden: "Ended: the page was not visible",
      "lost-sight": "Ended: no fresh telemetry from the robot. Move the slider again to go on.",
      busy: "Ended: a movement is running",
      "no-connection": "Ended: no connection for setpoints. Move the slider again to go on.",
    } satisfies Record<Exclude<EndedBecause, null>, string>,
  },

  view: {
    title: "Live view",
    label: "Three-dimensional view of the robot. Drag to turn, scroll to come closer.",
    waiting: "Waiting for the robot's drawing …",
    noWebgl: "This browser cannot draw in three dimensions (WebGL is off or missing). Everything else works.",
    failed: "The live view could not be loaded. Everything else works.",
    staleNote: "Last known pose",
    ghost: "Solid: measured. Blue: target.",
    reset: "Reset view",
  },

  plot: {
    title: "Last 20 seconds",
    quantity: {
      position_rad: "Position",
      velocity_rad_s: "Velocity",
      effort_nm: "Effort",
    } satisfies Record<Quantity, string>,
    unit: { position_rad: "°", velocity_rad_s: "°/s", effort_nm: "N m" } satisfies Record<Quantity, string>,
    choose: "What to plot",
    joints: "Joints to plot",
    failed: "The plot could not be loaded.",
    label: (quantity: string): string => `Plot of ${quantity} over the last 20 seconds`,
    seconds: "s",
  },

  poses: {
    title: "Joint frames",
    table: "Table of joint frames",
    frame: "Frame",
    position: "Position (m)",
    rotation: "Rotation",
    asDegrees: "Roll, pitch, yaw (°)",
    asQuaternion: "Quaternion (w, x, y, z)",
    none: "This device sends no frames.",
    showAs: "Show rotation as",
  },

  latency: {
    title: "Times",
    roundTrip: "Command round trip",
    explained: "From sending a target to the telemetry that answers it, on this computer's clock.",
    median: "median",
    p95: "95 %",
    latest: "latest",
    none: "Move a joint to measure it.",
    loopAge: "Loop age at the robot",
    loopExplained: "How old the telemetry was, to which the robot's last setpoint answered.",
    telemetryAge: "Telemetry age",
    watchdog: "Watchdog",
    samples: (count: number): string => `${count} samples`,
  },

  movements: {
    title: "Movements",
    run: "Run",
    runNamed: (name: string): string => `Run ${name}`,
    cancel: "Cancel",
    none: "There are no movements for this type of robot.",
    failed: (why: string): string => `The movements could not be read: ${why}`,
    retry: "Try again",
    own: "own",
    output: "What it printed",
    running: (name: string): string => `Running: ${name}`,
    status: {
      sent: "sent",
      accepted: "accepted",
      started: "started",
      done: "done",
      failed: "failed",
      expired: "expired",
      cancelled: "cancelled",
      refused: "refused",
    } satisfies Record<RunStatus, string>,
  },

  events: { title: "Events", none: "Nothing to report.", faults: "Faults" },
};
