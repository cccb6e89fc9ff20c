/** Every word that the page says, in one place, so that it can be said in another language. */
import type { Channel, RunStatus } from "../../features/actions/model/action-runner";
import type { Ended } from "../../features/control/model/control-request";
import type { Reach } from "../../features/devices/model/device-store";
import type { Line, SeenBy } from "../../features/control/model/command-trace";
import type { Deed, Problem } from "../../features/keyframes/model/keyframes";
import type { AnyRequest } from "../api/action-requests";
import type { Quantity } from "../../features/twin/model/recent-telemetry";
import type { Fault, HealthState, Severity } from "../../features/health/model/health";
import type { Way as WayToMeasure } from "../../features/latency/model/probe";
import type { FieldKind, Wrong } from "../../features/movements/model/parameter-form";
import type { Mode } from "../mqtt/protocol.generated";
import type { Outcome, Role, SharedRole } from "../../features/sharing/model/wire-types";
import type { Way } from "../../features/steering/model/steerable-parts";
import type { EndedBecause } from "../../features/steering/model/setpoint-streamer";
import type { Path, Transport } from "../../features/latency/model/latency-stats";

const moment = new Intl.DateTimeFormat("en-GB", { dateStyle: "medium", timeStyle: "short" });
const oneDigit = new Intl.NumberFormat("en", { minimumFractionDigits: 1, maximumFractionDigits: 1, useGrouping: false });

const timeOfDay = new Intl.DateTimeFormat("en-GB", { hour: "2-digit", minute: "2-digit", second: "2-digit" });
const dayOfMonth = new Intl.DateTimeFormat("en-GB", { day: "numeric", month: "short" });
const dayAndTime = new Intl.DateTimeFormat("en-GB", { day: "numeric", month: "short", hour: "2-digit", minute: "2-digit" });

function deg(rad: number): string {
  return texts.number.degrees((rad * 180) / Math.PI);
}

export const texts = {
  product: "Telescope",
  /** In the browser's tab. */
  titled: (page: string): string => (page === "" ? "Telescope" : `${page} · Telescope`),
  loading: "Loading …",
  skipToContent: "Skip to the content",

  later: {
    failed: "This page could not be loaded. Is the server reachable?",
    again: "Try again",
  },

  /** The parts of the console, in the bar above every page. */
  parts: {
    title: "Parts of the console",
    fleet: "Devices",
    health: "Health",
    times: "Times",
    movements: "Movements",
    robotTypes: "Robot types",
  },

  help: {
    what: "What do I see?",
    agent: {
      explained: "An agent is the program at the robot. In Telescope's folder, with its Python:",
      enroll: "Make an agent",
      run: "Run it",
    },
    first: {
      title: "Get going in three steps",
      explained:
        "A robot comes to Telescope by its agent, a program that runs beside it. On the machine at the robot, in Telescope's folder, with its Python:",
      pair: "Pair it: follow the link that the first command prints, or type its code on this page. Then the robot is yours, and is listed here.",
      simulated: "You have no robot? These commands simulate an arm. For another robot put its type in the place of ur5:",
      types: "all robot types",
      shared: "If somebody wants to share a robot with you, ask them for a link and open it here. You need no agent for that.",
    },
    pages: {
      fleet: [
        "Each line is a device: a robot, or a thing in a room such as a camera or a lamp. Open one to see and move it.",
        "Online means that it spoke a moment ago; stale, that it should have spoken since; offline, that its agent is not connected.",
        "One person at a time has control of a device. Everybody else who may operate it can stop it; a viewer only watches.",
      ],
      space: [
        "The plan is the room as its sensors see it: filled squares are taken, light ones free, and dim ones have not been seen.",
        "Robots and people are where they were last seen, with the way of their last half minute. What is grey is old.",
        "Numbers are things that hang in the room. Open one to see what it measures.",
      ],
      device: [
        "Live view: the robot as its joints were last measured. The blue ghost is where it was told to go. Nothing is guessed.",
        "Steer: moves it by hand while you have control. A velocity counts while you hold it; letting go, or losing the connection, stops it.",
        "What is asked of it (postures, speech, movements) runs by itself. Above stands how far it is, and what ends it.",
        "Camera, last 20 seconds and joint frames: pictures and values as the robot sends them, several times a second.",
        "Times: how long your last commands took on each part of their way. Events: what the robot has said about itself.",
        "Values are grey or say their age once they are older than they should be (stale). Offline means that its agent is not connected: what you see is what it said last.",
        "Stop is always there, and on Escape. It holds until somebody releases it on purpose; keep the machine's own button within reach.",
      ],
      roomDevice: [
        "Each card is one thing that this device says it can do: a picture, a scan, a number with its history, a switch or a slider.",
        "Values come from the device itself, when they change or at its own rate. Behind a number stand the limits that its room gives.",
        "Under a slider stands what the device has really set, which may be less than what was asked.",
        "What is older than three of its periods is grey and says its age (stale). Offline means that its agent is not connected.",
        "Stop ends what runs on it, and is on Escape. It holds until somebody releases it on purpose.",
      ],
      types: [
        "A device is one robot; its type is what all of its kind have in common.",
        "A type that is yours can be used by your own devices. A newer version takes the place of the one before once it has been checked.",
      ],
    },
  },

  robotTypes: {
    title: "Robot types",
    add: "Add a robot type",
    explained: "A robot type says what all robots of one kind have in common: joints and their limits, abilities, and the model that is drawn and simulated.",
    own: "Yours",
    builtIn: "Built in",
    noneOwn: "You have none of your own yet. Add one from its files.",
    failed: (why: string): string => `This could not be loaded. ${why}`,
    column: { version: "Version", joints: "Joints", users: "Used by", state: "State" },
    users: (count: number): string => (count === 0 ? "no device" : count === 1 ? "1 device" : `${count} devices`),
    state: { checking: "Being checked", ready: "Ready", refused: "Refused" },
    newer: (version: number, state: string): string => `Version ${version}: ${state.toLowerCase()}`,
    range: (from: string, to: string): string => `${from} to ${to}`,
    seconds: (s: number): string => (s < 1 ? "" : `${Math.floor(s)} s`),

    model: {
      title: "Model",
      label: "The robot in three dimensions. Drag to turn it, scroll to come nearer.",
      joints: "Move the joints of the picture",
      rest: "Back to rest",
      explained: "Only this picture moves. No robot does.",
      none: "This model cannot be drawn here.",
      notReady: "There is no picture until the model has been checked.",
    },

    facts: {
      title: "About this type",
      id: "Id",
      kind: "Kind",
      builtIn: "built in",
      own: "yours",
      uploaded: "Newest upload",
      upload: (version: number, at: string): string => `version ${version}, ${at}`,
      driver: "Driver",
      abilities: "Abilities",
      frames: "Frames",
      devices: "Devices of this type",
      noDevices: "No device yet.",
    },

    joints: {
      title: (count: number): string => (count === 1 ? "1 joint" : `${count} joints`),
      name: "Joint",
      from: "From",
      to: "To",
      fastest: "Fastest",
      speed: (degrees: string): string => `${degrees}/s`,
    },

    files: {
      title: "Files",
      all: "Download all",
    },

    own_type: {
      title: "Your robot type",
      next: "Upload the next version",
      remove: "Delete this robot type …",
      question: (label: string): string => `Delete ${label}, all its versions and files? This cannot be undone.`,
      yes: "Delete it",
      busy: "Deleting …",
      keep: "Keep it",
    },

    adding: {
      title: "Add a robot type",
      files: "Its files",
      explained:
        "You need robot.toml, the model and its scene as .xml (MuJoCo), meshes if it has any, and movements/*.py if you like. A zip of the folder will do. At most 32 files and 6 MB. Nothing is saved before you have seen it.",
      drop: "Drop a zip, a folder or files here",
      chooseFiles: "Choose a zip or files",
      chooseFolder: "Choose a folder",
      reading: "Reading the files …",
      badArchive: (name: string): string => `${name} cannot be unpacked. Is it a whole zip, without a password, and below 50 MB?`,
      unreadable: "A file could not be read. Choose it again.",
      chosen: "Chosen files",
      left: (names: readonly string[]): string => `Not needed, and not sent: ${names.slice(0, 5).join(", ")}${names.length > 5 ? ` and ${names.length - 5} more` : ""}`,
      clear: "Begin again without files",
      wrong: "to be mended",
      replace: "Replace …",
      replaceNamed: (name: string): string => `Replace ${name}`,
      remove: "Remove",
      removeNamed: (name: string): string => `Remove ${name}`,
      under: {
        sending: "Sending the files …",
        checking: "The model is being compiled and checked …",
        saving: "Saving, and checking what is saved …",
      },
      fault: {
        "no-manifest": (name: string): string => `There is no ${name} among the files. It says what the robot can do; add it.`,
        "too-large": (): string => "The files are larger than 6 MB together. Simplify the meshes, or leave some out.",
      },
      unsent: (why: string): string => `That did not work; your files are still here. ${why}`,
      good: (label: string): string => `${label} is ready to be saved`,
      look: "Look whether it is what you mean: move each joint of the picture, and compare the limits.",
      save: (type: string): string => `Save as ${type}`,
      expires: (at: string): string => `Only you see it. It is kept for this until ${at}.`,
      saved: (label: string, version: number): string => `${label}, version ${version}, is saved`,
      savedExplained: "It is in your list, and its movements can be run as soon as a robot of it is there.",
      accepted: "accepted",
      open: "Open its page",
      another: "Add another",
    },

    found: {
      title: "What was found",
      joints: "Joints",
      joint: (label: string, range: string): string => `${label} (${range})`,
      actuators: "Motors",
      cameras: "Cameras",
      movements: "Movements",
      abilities: "Abilities",
      count: (name: string, count: number): string => `${name}: ${count}`,
      none: "none",
    },

    findings: {
      title: {
        error: (count: number): string => (count === 1 ? "1 thing is wrong" : `${count} things are wrong`),
        warning: (count: number): string => (count === 1 ? "1 thing to know" : `${count} things to know`),
      },
      whole: "The robot type as a whole",
      line: (line: number): string => `line ${line}`,
      missing: (name: string): string => `It needs the file ${name}, which is not here.`,
      torn: "This is not well-formed XML: a tag is not closed, or closed by another's name.",
      range: (joint: string, from: string, to: string): string =>
        `The model lets joint ${joint} go from ${from} to ${to}; robot.toml lets it go further.`,
      motorRange: (motor: string, from: string, to: string): string =>
        `The model lets motor ${motor} go from ${from} to ${to}; robot.toml lets it go further.`,
      advice: {
        range: (file: string): string =>
          `Make lower_rad and upper_rad in robot.toml narrower, or the range in ${file} wider. Without <compiler angle="radian"/> the model's ranges are in degrees.`,
        missing: (file: string, name: string): string => `Add ${name}, or take it out of ${file}.`,
        torn: (): string => "Look at this line and the ones before it, mend them, and replace the file.",
        word: (): string => "Look the word up in MuJoCo's XML reference; it may be misspelt.",
        element: (): string => "MuJoCo knows no such element here. It may be misspelt, or stand in the wrong place.",
        unnamed: (): string => "Joints, their motors and robot.toml have to use the same names.",
        servo: (): string => "Each joint needs a <position> motor of its own name, on that joint alone, with gear 1; a wheel a <velocity> motor.",
        shape: (): string => "Use hinge or slide joints below the robot's base.",
        unstable: (): string => "Make its motors weaker (kp), its joints better damped, or its masses larger.",
        outside: (): string => "Everything has to lie in the robot type's own folder. Use names below it.",
        manifest: (): string => "Mend this line of robot.toml. A value that is text stands in quotation marks.",
        field: (): string => "Correct this in robot.toml, and replace the file.",
        script: (): string => "Mend the script. Nothing of it has been run.",
        builtIn: (): string => "Change type in robot.toml.",
        heavy: (): string => "Use fewer and simpler meshes and bodies.",
        checker: (): string => "Try again. If it stays so, ask whoever runs this Telescope.",
        camera: (): string => "Without one there is no picture of a simulated robot. Add a <camera name=\"picture\"> to the scene.",
        idle: (): string => "That may be meant so. If not, add the joint to robot.toml.",
        mesh: (): string => "That is only in this picture. What touches and moves is as you made it.",
        invisible: (): string => "Give it shapes in group 2 to be seen.",
        other: (): string => "",
      },
    },

    next: {
      title: "Next: start an agent with it",
      folder: (type: string): string => `Put the type's files into a folder called ${type}, and the folder around it into TELESCOPE_ROBOTS_PATH.`,
      code: "Redeem the code that the first command prints, on the page of your devices.",
    },
  },

  number: {
    oneDigit: (value: number): string => oneDigit.format(Object.is(Math.round(value * 10), -0) ? 0 : value),
    degrees: (value: number): string => `${texts.number.oneDigit(value)}°`,
    wholeDegrees: (value: number): string => `${Math.round(value)}°`,
    percent: (share: number): string => `${Math.round(share * 100)} %`,
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

  /** A time of the server's, as RFC 3339. */
  moment: (at: string): string => moment.format(new Date(at)),
  until: (at: string | null): string => (at === null ? "until it is ended" : `until ${texts.moment(at)}`),

  session: {
    checking: "Finding out who you are …",
    title: "Sign in",
    failed: "That did not work",
    name: "Name",
    password: "Password",
    enter: "Sign in",
    elsewhere: (name: string): string => `Sign in with ${name}`,
    leaving: "Going there …",
    elsewhereExpired: "That took too long, or was begun in another browser. Begin again.",
    elsewhereUninvited: "Nobody has invited you here. Ask somebody for an invitation, or whoever runs this server.",
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

  role: { owner: "Owner", operator: "Operator", viewer: "Viewer" } satisfies Record<Role, string>,
  roleExplained: {
    operator: "takes control, runs movements, stops it",
    viewer: "sees it live, changes nothing",
  } satisfies Record<SharedRole, string>,

  lasting: {
    never: "until I end it",
    hour: "1 hour",
    workday: "8 hours",
    day: "1 day",
    week: "7 days",
    month: "30 days",
    date: "until a date …",
    keep: "as it is now",
    pick: "Until when",
    past: "Choose a time that is still to come.",
    /** A length of time, roughly: to say how long a part will last. */
    about: (s: number): string => {
      const [count, unit] = s < 5400 ? [s / 60, "minute"] : s < 2 * 86_400 ? [s / 3600, "hour"] : [s / 86_400, "day"];
      const whole = Math.max(1, Math.round(count));
      return whole === 1 ? `1 ${unit}` : `${whole} ${unit}s`;
    },
  },

  once: {
    copy: "Copy",
    copied: "Copied.",
    byHand: "This browser does not let a page copy here. It is selected: copy it with Ctrl+C, or ⌘C.",
  },

  access: {
    title: "Who has access",
    loading: "Finding out who has access …",
    failed: (why: string): string => `Who has access could not be read: ${why}`,
    again: "Try again",
    you: "you",
    none: "Nobody else.",
    owned: (owner: string, role: string): string => `${owner} owns this. Your part: ${role.toLowerCase()}.`,
    leave: "Give up my access",
    leaveSure: "Give it up? Only the owner can give it back.",
    leaveYes: "Yes, give it up",
    leaving: "Giving it up …",
    elsewhere: "You have access through the whole space. Give it up on the space's page.",
    keep: "Keep it",
    since: (by: string, at: string): string => `from ${by}, ${texts.moment(at)}`,
    change: "Change",
    changeOf: (name: string): string => `Change the access of ${name}`,
    remove: "Remove",
    removeOf: (name: string): string => `Remove the access of ${name}`,
    removing: "Removing …",
    removed: (name: string): string => `${name} no longer has access. What they were doing here was ended at once.`,
    undo: "Undo",
    undoing: "Giving it back …",
    restored: (name: string): string => `${name} has access again.`,
    save: "Save",
    saving: "Saving …",
    cancel: "Cancel",
    changed: (name: string, role: string, until: string): string => `${name}: ${role.toLowerCase()}, ${until}.`,
    inSpace: "Through the whole space",
    inSpaceNote: "These people have access to everything in the space. Change that on the space's page:",
    spaceNote: "Whoever is invited here has access to every device in this space, and to those that come into it later.",
    links: "Links that can still be used",
    linkFor: {
      operator: "Link for an operator",
      viewer: "Link for a viewer",
      owner: "An offer to hand it over",
    } satisfies Record<Role, string>,
    uses: (count: number): string => (count === 1 ? "1 use left" : `${count} uses left`),
    lasts: (s: number | null): string => (s === null ? "access until it is ended" : `access for ${texts.lasting.about(s)}`),
    withdraw: "Take back",
    withdrawSure: "Take it back? Nobody can use it then.",
    withdrawYes: "Yes, take it back",
    withdrawing: "Taking it back …",
  },

  invite: {
    open: "Invite somebody",
    title: "Invite somebody",
    close: "Close",
    how: "How to invite",
    byName: "By name",
    byLink: "By link",
    name: "Name of their account",
    nameNote: "As they sign in with it here. They have access as soon as you share.",
    role: "They may",
    operate: "Operate",
    watch: "Watch",
    lasts: "Access lasts",
    uses: "How many people",
    usesNote: "1 to 50; each account once.",
    valid: "The link works for",
    linkNote: "Whoever has the link gets access. Who has no account yet can make one with it.",
    share: "Share",
    sharing: "Sharing …",
    shared: (name: string): string => `Shared with ${name}.`,
    make: "Make link",
    making: "Making the link …",
    made: "The link is ready. Copy it now: it is shown this once.",
    link: "Invitation link",
    madeNote: (role: string, uses: number, until: string): string =>
      `${role}, for ${uses === 1 ? "one person" : `up to ${uses} people`}; it works ${until}.`,
    done: "I have it",
  },

  transfer: {
    title: "Hand it over for good",
    open: "Hand it over",
    goes: {
      agent: (names: readonly string[]): string =>
        names.length === 1 ? `${names[0]} goes.` : `All that is behind the same agent goes: ${names.join(", ")}.`,
      space: (names: readonly string[]): string =>
        names.length === 0 ? "The space goes; nothing stands in it." : `The space goes with all that is in it: ${names.join(", ")}.`,
    },
    terms: [
      "Nothing changes before the other one accepts, and until then you can take the offer back.",
      "Once accepted it is theirs. You cannot undo that; only they can hand it back.",
      "Then control ends, whatever runs is cancelled, and everybody whom you shared it with loses access.",
      "Recordings, measurements and movements stay with you and do not go along.",
    ],
    to: "To whom",
    toName: "One account",
    toLink: "Whoever has the link",
    valid: "The offer stands for",
    todo: "Make the offer",
    doing: "Making the offer …",
    madeNote: (until: string): string => `Send it to the new owner. It can be accepted ${until}, once.`,
    none: "It is not offered to anybody.",
    offered: (name: string | null): string => (name === null ? "Offered to whoever has the link" : `Offered to ${name}`),
    waits: (until: string): string => `not accepted yet · ${until}`,
    withdrawSure: "Take the offer back? Its link is worth nothing then.",
    failed: (why: string): string => `What is offered could not be read: ${why}`,
  },

  invitation: {
    title: "You are invited",
    outside:
      "Somebody shares a robot or a room with you. Make an account here, or sign in with the one you have; then you see what it is.",
    expected: "Make an account",
    name: "Your name",
    nameNote: "You sign in with it, and others here see it. It cannot be changed.",
    password: "Choose a password",
    passwordNote: "At least twelve characters; a sentence of a few words is a good one.",
    join: "Make account and accept",
    joining: "Making your account …",
    haveOne: "I have an account",
    notNow: "I do not want it",
    looking: "Looking at the invitation …",
    offers: (by: string, label: string): string => `${by} invites you to ${label}`,
    kind: {
      device: "It is one device.",
      space: "It is a whole space: every device in it, and those that come into it later.",
      agent: "",
    },
    may: { operator: "You may operate it: take control, run movements, stop it.", viewer: "You may watch it live, and change nothing." },
    lasts: (s: number | null): string =>
      s === null ? "It lasts until the owner ends it." : `It lasts ${texts.lasting.about(s)} from when you accept.`,
    hands: (by: string, label: string): string => `${by} hands ${label} over to you`,
    handsNote: [
      "It becomes yours, with everything in it: you decide then who else has access, and whoever has now loses it.",
      "Whatever runs on it is cancelled. What was measured and recorded before stays with the former owner.",
      "You can hand it back, but not undo this.",
    ],
    handsSure: (label: string): string => `Take ${label} over?`,
    handsYes: "Yes, it shall be mine",
    handsKeep: "Not yet",
    declined: "If you do not want it nothing happens: it stays with its owner, and the offer ends by itself.",
    into: "Put it into",
    accept: "Accept",
    acceptTransfer: "Take it over",
    accepting: "Accepting …",
    as: (name: string): string => `You are signed in as ${name}.`,
    retry: "Try again",
    toDevices: "To my devices",
    accepted: (label: string): string => `You have access to ${label}.`,
    taken: (label: string): string => `${label} is yours.`,
    openIt: (label: string): string => `Open ${label}`,
    joined: "Your account is made, and the invitation is accepted. This is shared with you:",
    joinedNothing: "Your account is made, but nothing is shared with it: somebody else used the invitation first. Ask for another one.",
  },

  spaces: {
    title: "Spaces",
    none: "No space yet.",
    devices: (count: number): string => (count === 1 ? "1 device" : count === 0 ? "no device yet" : `${count} devices`),
    of: (owner: string): string => `of ${owner}`,
    new: "Make a space",
    name: "Name of the new space",
    make: "Make space",
    making: "Making it …",
    made: (name: string): string => `${name} is there. Agents can be claimed into it.`,
    failed: (why: string): string => `The spaces could not be read: ${why}`,
    missing: "There is no such space, or you may not see it.",
    empty: "There is no device in it yet.",
  },

  keys: {
    title: "API keys",
    explained:
      "For a program of your own or somebody else's. A key watches, or operates too; it never shares, pairs, resets a Stop or makes keys.",
    none: "You have no API key.",
    failed: (why: string): string => `Your API keys could not be read: ${why}`,
    new: "Make an API key",
    name: "What is it for",
    nameExample: "Night shift dashboard",
    role: "It may",
    only: "It may touch",
    all: "All that I may",
    some: "Only these",
    devices: "Devices",
    spaces: "Whole spaces",
    chooseOne: "Choose at least one device or space.",
    days: "Good for (days)",
    daysNote: "1 to 366. A short one is safer.",
    make: "Make key",
    making: "Making the key …",
    made: (name: string): string => `The key “${name}” is ready. Copy it now: it is shown this once.`,
    token: "API key",
    use: "A program sends it with each request, as",
    done: "I have it",
    everything: "everything of yours",
    onlyThese: (what: string): string => `only ${what}`,
    made2: (at: string): string => `made ${texts.moment(at)}`,
    until: (at: string): string => `good until ${texts.moment(at)}`,
    expired: (at: string): string => `ran out ${texts.moment(at)}`,
    expiredChip: "Expired",
    used: (at: string): string => `last used about ${texts.moment(at)}`,
    unused: "never used",
    revoke: "Revoke",
    revokeOf: (name: string): string => `Revoke the key ${name}`,
    revokeSure: (name: string): string => `Revoke “${name}”? Its program stops working at once; this cannot be undone.`,
    revokeYes: "Yes, revoke it",
    revoking: "Revoking …",
    revoked: (name: string): string => `“${name}” is revoked.`,
    keep: "Keep it",
    nameless: "a device or space that is gone",
  },

  activity: {
    title: "What was done",
    link: "What was done in your account",
    explained:
      "Everything that was done in your account and with your devices, whoever did it. It cannot be changed afterwards: each line is chained to the one before it.",
    back: "Your account",
    filters: "Show only",
    kind: "Kind",
    about: "About",
    from: "From",
    to: "To",
    any: "everything",
    control: "Control and Stop",
    sharing: "Access to it",
    reset: "Show everything",
    none: "Nothing was recorded for this choice.",
    noneYet: "Nothing in the records looked through so far.",
    more: "Show older",
    further: "Look further back",
    end: "That is all.",
    failed: (why: string): string => `It could not be read: ${why}`,
    again: "Try again",
    shown: (count: number): string => (count === 1 ? "1 line" : `${count} lines`),
    details: "Details",
    outcome: { done: "", refused: "refused", failed: "failed", unknown: "cut off" } satisfies Record<Outcome, string>,
    unknownExplained: "Whoever did it was interrupted in the middle; look at what it is about.",
    byKey: "with an API key",
    somebody: "Somebody",
    cloud: "The server",
    anAccount: (id: string): string => `an account that is no longer known (${id})`,
    key: { number: "Number", account: "Account", session: "Sign-in", key: "API key", on: "On", hash: "Hash" },
    kinds: {
      "signed-in": "Signed in",
      "sign-in-refused": "Sign-in refused",
      "signed-out": "Signed out",
      "account-made": "Account made",
      "password-set": "Password set",
      "api-key-made": "API key made",
      "api-key-revoked": "API key revoked",
      "space-made": "Space made",
      "agent-claimed": "Agent paired",
      "claim-refused": "Claim code refused",
      "agent-unpaired": "Agent unpaired",
      "agent-moved": "Agent moved",
      "device-renamed": "Device renamed",
      shared: "Shared",
      unshared: "Access ended",
      invited: "Invited",
      "invitation-redeemed": "Invitation accepted",
      "invitation-revoked": "Invitation taken back",
      transferred: "Handed over",
      "movement-saved": "Movement saved",
      "movement-deleted": "Movement deleted",
      "robot-type-uploaded": "Robot type added",
      "robot-type-deleted": "Robot type deleted",
      "control-taken": "Control taken",
      "control-taken-over": "Control taken over",
      "control-handed-over": "Control handed over",
      "control-released": "Control given back",
      "control-expired": "Control ran out",
      "control-ended": "Control ended",
      "control-requested": "Control asked for",
      "control-request-refused": "Request for control refused",
      "control-request-withdrawn": "Request for control withdrawn",
      "control-request-lapsed": "Request for control not answered",
      "stop-ordered": "Stop",
      "stop-reset-ordered": "Stop reset",
      "order-refused": "Order refused",
    } as Readonly<Record<string, string>>,
    /** One line for each kind that has no words of its own in the record. */
    says: {
      signedIn: (who: string, how: string): string => `${who} signed in ${how}.`,
      how: { link: "by a link", password: "by password", "open-id": "at the provider" } as Readonly<Record<string, string>>,
      refusedSignIn: "A sign-in was refused.",
      signedOut: (who: string): string => `${who} signed out.`,
      keyEnded: (who: string): string => `All that ${who} was doing was ended.`,
      accountMade: (who: string): string => `The account of ${who} was made.`,
      passwordSet: (who: string): string => `${who} set a new password.`,
      keyMade: (who: string, name: string, role: string, only: string): string =>
        `${who} made the API key “${name}”: ${role.toLowerCase()}, ${only}.`,
      keyRevoked: (who: string, name: string): string => `${who} revoked ${name === "" ? "an API key" : `the API key “${name}”`}.`,
      spaceMade: (who: string, name: string): string => `${who} made the space ${name}.`,
      claimed: (who: string, agent: string, space: string): string => `${who} paired the agent ${agent} into ${space}.`,
      claimRefused: (who: string): string => `${who} was refused with a claim code.`,
      unpaired: (who: string, agent: string): string => `${who} unpaired the agent ${agent}.`,
      moved: (who: string, agent: string, space: string): string => `${who} moved the agent ${agent} to ${space}.`,
      renamed: (who: string, label: string, on: string): string =>
        label === "" ? `${who} calls ${on} as its agent does.` : `${who} called it “${label}”: ${on}.`,
      shared: (who: string, what: string, other: string, role: string, until: string): string =>
        `${who} shared ${what} with ${other} as ${role.toLowerCase()}, ${until}.`,
      unshared: (who: string, what: string, other: string): string => `${who} ended ${other}’s access to ${what}.`,
      left: (who: string, what: string): string => `${who} gave up their access to ${what}.`,
      ranOut: (what: string, other: string): string => `${other}’s access to ${what} ran out, or ended with what it was part of.`,
      invited: (who: string, what: string, role: string, uses: string): string =>
        `${who} made an invitation to ${what}: ${role.toLowerCase()}, ${uses}.`,
      offered: (who: string, what: string): string => `${who} offered to hand ${what} over.`,
      redeemed: (who: string, what: string): string => `${who} accepted an invitation to ${what}.`,
      withdrawn: (who: string, what: string): string => `${who} took an invitation to ${what} back.`,
      transferred: (who: string, what: string): string => `${who} took ${what} over.`,
      movementSaved: (who: string, what: string): string => `${who} saved the movement ${what}.`,
      movementDeleted: (who: string, what: string): string => `${who} deleted the movement ${what}.`,
      typeUploaded: (who: string, what: string): string => `${who} added the robot type ${what}.`,
      typeDeleted: (who: string, what: string): string => `${who} deleted the robot type ${what}.`,
      other: (who: string, what: string, on: string): string => (on === "" ? `${who}: ${what}.` : `${who}: ${what}, ${on}.`),
    },
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
    open: "Pair a device",
    byCode: "By its claim code",
    explain:
      "Type the code that the agent shows when it starts; it is good for five minutes. Where its terminal shows a QR code, a phone’s camera opens this page with it.",
    linked: "You followed an agent’s link. Nothing is paired before you say so: pair only what you, or somebody you trust, has started.",
    code: "Claim code",
    example: "BCDF-GHJK",
    into: "Put it into",
    firstSpace: "your first space",
    newSpace: "A new space …",
    submit: "Pair",
    busy: "Pairing …",
    notThis: "Not this one",
    malformed: "A claim code has eight letters, such as BCDF-GHJK. There are no vowels and no digits in it.",
    unknown:
      "Nothing is paired: this code is wrong, has run out, or was used already. Look at the agent: it shows a new code every five minutes, and none once it is paired. If it is yours already, it is among your devices.",
    done: (count: number): string => (count === 1 ? "Paired: one device" : `Paired: ${count} devices`),
    doneNote: "This is what the agent has brought. Call it what you like, for everybody who sees it.",
    waiting: "Waiting for its first word …",
    another: "Pair another",
    signInFirst: "You followed a link that pairs a device. Sign in, and you go on from there.",
  },

  naming: {
    rename: "Rename",
    renameOf: (label: string): string => `Rename ${label}`,
    name: "Name",
    save: "Save",
    saving: "Saving …",
    cancel: "Cancel",
    called: (label: string): string => `It is called ${label} now.`,
    undo: "Undo",
  },

  device: {
    back: "All devices",
    missing: "There is no such device, or you may not see it.",
    gone: (label: string): string => `You no longer have access to ${label}.`,
    goneWhy:
      "Its owner ended it, its time ran out, or the device was unpaired. What you were doing with it was ended at once. Ask its owner if you need it again.",
    simulated: "simulated",
    unreadable: (what: string): string => `A message of this device could not be read: ${what}.`,
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
    tookOver: (holder: string, why: string): string => `${holder} took over: ${why}`,
    handed: (to: string): string => `You handed control to ${to}`,
    read: "OK",
  },

  /** Asking for control and answering, and the owner's way past both. */
  handover: {
    ask: "Ask for control",
    asking: "Asking …",
    asked: (of: string): string => `You ask ${of} for control.`,
    notShown: "The robot does not answer, so it may be noticed late.",
    left: (s: number): string => `${s} s to answer`,
    leftFor: (s: number): string => `${s} s left`,
    withdraw: "Ask no longer",
    somebody: "whoever has it",
    wants: (by: string): string => `${by} asks you for control.`,
    accept: (by: string): string => `Hand over to ${by}`,
    keep: "Keep control",
    accepting: "Handing over …",
    refusing: "Telling them …",
    effect: "What moves is held when you hand over. Without an answer you keep control.",
    over: {
      accepted: (of: string): string => `${of} handed control to you.`,
      refused: (of: string): string => `${of} keeps control.`,
      withdrawn: (): string => "You ask no longer.",
      lapsed: (of: string): string => `${of} did not answer in time, and keeps control.`,
      ended: (of: string): string => `${of} has control no longer. Take it, if nobody else has.`,
    } satisfies Record<Ended, (of: string) => string>,
    kept: (by: string): string => `You keep control; ${by} is told so.`,
    gone: (by: string): string => `${by} asks no longer.`,
    failed: (why: string): string => `That did not work: ${why}`,
    takeOver: "Take over …",
    takeOverNow: "Take over",
    takingOver: "Taking over …",
    reason: (of: string): string => `Why you take control from ${of}`,
    reasonNote: "They read it. What moves is held.",
    never: "Leave it",
  },

  others: {
    count: (others: number): string => (others === 1 ? "1 other watches" : `${others} others watch`),
    title: "Who else watches",
    mine: "you, signed in elsewhere",
    since: (age: string): string => `came ${age}`,
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
    takeFirst: "Take control to move the robot.",
    waiting: "Waiting for the robot …",
    streaming: "Sending targets",
    busy: "A movement is running.",
    stopped: "The robot is stopped.",
    limited: (what: string): string => `Limited by the robot: ${what}`,
    noDescription: "Waiting for the robot's description …",
    ended: {
      reached: "Target reached",
      stuck: "The robot stopped short of the target",
      "let-go": "",
      stopped: "Ended: the robot is stopped",
      hidden: "Ended: the page was not visible",
      "lost-sight": "Ended: no fresh telemetry from the robot. Move the slider again to go on.",
      busy: "Ended: a movement is running",
      "no-connection": "Ended: no connection for setpoints. Move the slider again to go on.",
    } satisfies Record<Exclude<EndedBecause, null>, string>,
  },

  steer: {
    title: "Steer",
    ways: "Ways to steer",
    way: { joints: "Joints", jog: "Cartesian", drive: "Drive" } satisfies Record<Way, string>,
    holding: "Moving while you hold",
    showKeys: "Keys",
    everywhere: "These keys work wherever the focus is on this page, except in a text field",
    frame: "Frame",
    axes: "Along whose axes",
    inBase: "Axes of the base",
    inTool: "Axes of the frame",
    along: "Move along",
    about: "Turn about",
    pad: (name: string, sign: 1 | -1): string => `${sign > 0 ? "Plus" : "Minus"} ${name}: moves while you hold it`,
    padShort: (name: string, sign: 1 | -1): string => `${sign > 0 ? "+" : "−"} ${name}`,
    linear: "Speed along",
    angular: "Speed of turning",
    millimetres: (value: number): string => `${Math.round(value)} mm/s`,
    metres: (value: number): string => `${value.toFixed(3)} m`,
    metresPerSecond: (value: number): string => `${(Math.abs(value) < 0.005 ? 0 : value).toFixed(2)} m/s`,
    degreesPerSecond: (value: number): string => `${Object.is(value, -0) ? 0 : value} °/s`,
    poseOf: (frame: string): string => `Where ${frame} is, in the axes of the base`,
    stick: "Drive stick: up is forward, to a side turns. With the focus here, arrow keys and W A S D drive while you hold them.",
    sideways: { left: "To the left: moves while you hold it", right: "To the right: moves while you hold it" },
    upTo: "Speed, up to",
    driveSpeed: (forward: number, turn: number): string => `${forward.toFixed(2)} m/s · ${Math.round(turn)} °/s`,
    asked: "Asked",
    measured: "Measured",
    part: { forward_m_s: "Forward", left_m_s: "To the left", turn_rad_s: "Turning left" },
    keys: {
      joints: [
        [["1", "…", "9", "0"], "choose a joint"],
        [["[", "]"], "the joint before, the next"],
        [["↑", "↓"], "turn the chosen joint while held"],
      ],
      jog: [
        [["W", "S"], "plus and minus x while held"],
        [["A", "D"], "plus and minus y"],
        [["R", "F"], "plus and minus z"],
        [["O", "U"], "plus and minus roll"],
        [["I", "K"], "plus and minus pitch"],
        [["J", "L"], "plus and minus yaw"],
      ],
      drive: [
        [["W", "S", "↑", "↓"], "forward and back while held"],
        [["A", "D", "←", "→"], "turn left and right"],
        [["Q", "E"], "to the left and right, where the robot can"],
      ],
      always: [
        [["T"], "take control, or release it"],
        [["?"], "show or hide these keys"],
        [["Esc"], "stop"],
      ],
    } satisfies Record<Way | "always", [string[], string][]>,
    padKeys: {
      joints:
        "Gamepad: hold a shoulder button (LB or RB); the left stick turns the chosen joint, the cross chooses another. B stops.",
      jog: "Gamepad: hold a shoulder button (LB or RB); the left stick moves x and y, the triggers z, the right stick rolls and pitches, the cross yaws. B stops.",
      drive: "Gamepad: hold a shoulder button (LB or RB); the left stick drives, the right stick goes sideways where the robot can. B stops.",
    } satisfies Record<Way, string>,
    pads: {
      connected: (id: string): string => `Gamepad connected: ${id}. Hold a shoulder button to move the robot.`,
      gone: (id: string): string => `Gamepad disconnected: ${id}.`,
      unknown: (id: string): string => `This gamepad has a layout that is not known, so it moves nothing: ${id}.`,
    },
  },

  together: {
    title: (count: number): string => `${count} robots`,
    pick: (label: string): string => `Operate ${label} together with others`,
    picked: (count: number): string => (count === 1 ? "1 robot is ticked. Tick another one." : `${count} robots are ticked.`),
    open: "Operate together",
    none: "Tick none",
    missing: "A device of this address is not there, or not yours to see.",
    stopAll: "Stop all",
    stopAllExplained: "The Escape key stops all robots on this page, wherever the focus is.",
    keysHere: "Keys and gamepad",
    keysFor: (label: string): string => `Keys and gamepad move ${label}.`,
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
    /** A joint's limits; where both are as far, one of them says it. */
    limits: ([low, high]: readonly [number, number], unit: string): string => {
      const text = (value: number): string => String(Number(value.toPrecision(3)));
      return low === -high ? `±${text(high)} ${unit}` : `${text(low)} to ${text(high)} ${unit}`;
    },
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
    which: "Which frames",
    told: "As the robot tells",
    joints: "Every joint",
    reckoned: "Reckoned on this page: the robot's own drawing, with its joints as they were measured.",
    old: "The last that was heard.",
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

  library: {
    title: "Movements",
    explain: "Scripts that a robot runs by itself: those that come with it, and your own. Open one to read, change or run it.",
    search: "Search",
    searchExample: "Name, description or robot type",
    nothing: "Nothing fits your search.",
    count: (count: number): string => (count === 1 ? "1 movement" : `${count} movements`),
    builtIn: "built in",
    own: "own",
    shipped: (version: number): string => `Version ${version}, comes with the robot type`,
    saved: (version: number, at: string): string => `Version ${version}, saved by you on ${texts.moment(at)}`,
    remove: "Delete",
    removeOf: (name: string): string => `Delete ${name}`,
    removeSure: (name: string): string => `Delete ${name} with all its versions?`,
    removeYes: "Yes, delete it",
    removing: "Deleting …",
    removed: (name: string): string => `${name} is deleted. One of the same name that comes with the robot type is used again.`,
    keep: "Keep it",
    create: "New movement",
    robotType: "Robot type",
    name: "Name",
    nameExample: "bow_twice",
    beginKeyframes: "New with keyframes",
    begin: "Begin",
    badName: "A name has letters without accents, digits, _ and -, and no spaces; at most 64.",
    taken: "There is a movement of this name for this robot type already.",
    /** What a new movement begins with. */
    template: `"""Say in one line what it does."""

PARAMETERS = {
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 1,
        "default": 0.3,
        "description": "Share of the joints' velocity limits",
    },
}

robot.home(speed=parameters["speed"])
print("done")
`,
  },

  editor: {
    title: "Script",
    label: (name: string): string => `Script of ${name}, in Python`,
    keys: "Ctrl+Space offers what can be written here. Tab leads on to the next control; Escape leaves the editor, or stops the robots that are chosen.",
    save: "Save",
    saving: "Saving …",
    isNew: "New: not saved yet",
    changed: (version: number): string => `Changed since version ${version}`,
    isSaved: (version: number, builtIn: boolean): string => (builtIn ? `Version ${version}, built in` : `Saved as version ${version}`),
    failed: (why: string): string => `The movement could not be read: ${why}`,
    refused: (why: string): string => `Not saved. ${why} Your text is kept in this browser.`,
    restored: (age: string): string => `This is text that you had not saved, from ${age}.`,
    discard: "Discard it",
    discarded: "This is the saved text again.",
    bringBack: "Undo",
    deleted: "Not saved: the movement has been deleted meanwhile. Your text is still here.",
    conflict: (version: number, at: string): string =>
      `Not saved: version ${version} was saved meanwhile, on ${texts.moment(at)}. Below is your text, with what is different in it.`,
    bothLabel: (version: number): string => `Your text, compared with version ${version}`,
    saveMine: "Save mine as the newest",
    takeTheirs: (version: number): string => `Go on with version ${version}`,
    unchecked: (why: string): string => `It could not be checked: ${why}`,
    problems: "What is wrong",
    count: (errors: number, all: number): string => {
      if (all === 0) return "Nothing is wrong that can be seen without running it.";
      const warnings = all - errors;
      const parts = [
        ...(errors > 0 ? [errors === 1 ? "1 error" : `${errors} errors`] : []),
        ...(warnings > 0 ? [warnings === 1 ? "1 warning" : `${warnings} warnings`] : []),
      ];
      return `${parts.join(", ")}:`;
    },
    line: (line: number): string => `Line ${line}`,
  },

  versions: {
    title: "Versions",
    one: (version: number): string => `Version ${version}`,
    look: "Look",
    lookAt: (version: number): string => `Look at version ${version}`,
    close: "Close",
    closeOf: (version: number): string => `Close version ${version}`,
    same: (version: number): string => `Version ${version} is the text in the editor.`,
    explain: (version: number): string => `What stands in the editor now, with what has changed in it since version ${version}:`,
    label: (version: number): string => `The text in the editor, compared with version ${version}`,
    restore: (version: number): string => `Save version ${version} again as the newest`,
  },

  parameters: {
    title: "Parameters",
    of: (name: string): string => `Parameters of ${name}`,
    none: "It has no parameters.",
    withDefaults: "Runs with the default parameters",
    reset: "Defaults",
    optional: "(may be empty)",
    choose: "Choose …",
    mend: "Something above has to be mended first.",
    range: (least: number | null, most: number | null, unit: string): string => {
      const of = (value: number): string => `${value}${unit.startsWith("°") || unit === "" ? unit : ` ${unit}`}`;
      if (least !== null && most !== null) return `${of(least)} to ${of(most)}`;
      if (least !== null) return `at least ${of(least)}`;
      return most === null ? "" : `at most ${of(most)}`;
    },
    how: {
      number: "",
      integer: "a whole number",
      text: "",
      choice: "",
      "yes-no": "",
      list: "numbers with spaces between",
      json: "as JSON",
    } satisfies Record<FieldKind, string>,
    wrong: (wrong: Wrong, unit: string): string => {
      const limit = "limit" in wrong ? `${wrong.limit} ${unit}`.trim() : "";
      switch (wrong.kind) {
        case "missing":
          return "This has to be given.";
        case "number":
          return "This is not a number.";
        case "whole":
          return "This has to be a whole number.";
        case "json":
          return "This is not JSON.";
        case "least":
          return `At least ${limit}.`;
        case "most":
          return `At most ${limit}.`;
        case "above":
          return `More than ${limit}.`;
        case "below":
          return `Less than ${limit}.`;
        case "shorter":
          return `At least ${wrong.limit} characters.`;
        case "longer":
          return `At most ${wrong.limit} characters.`;
        case "fewer":
          return `At least ${wrong.limit} values.`;
        case "more":
          return `At most ${wrong.limit} values.`;
      }
    },
  },

  many: {
    title: "Run it",
    bar: "Robots that are chosen",
    robots: "On which robots",
    none: "You have no robot of this type.",
    others: (labels: readonly string[]): string =>
      `Not on ${labels.join(", ")}: a robot that is shared with you runs its owner's movements, on its own page.`,
    chooseAll: "Choose all",
    chosen: (count: number): string => (count === 1 ? "One robot is chosen" : `${count} robots are chosen`),
    running: (count: number, all: number): string => (all === 1 ? "It runs" : `It runs on ${count} of ${all} robots`),
    run: (count: number): string => (count < 2 ? "Run" : `Run on ${count} robots`),
    saveAndRun: (count: number): string => (count < 2 ? "Save and run" : `Save, and run on ${count} robots`),
    asking: "Asking …",
    rows: "What becomes of it",
    cancelAll: "Cancel all",
    stopAll: "Stop all",
    cancelOf: (label: string): string => `Cancel on ${label}`,
    stopOf: (label: string): string => `Stop ${label}`,
    outputOf: (label: string): string => `What it printed on ${label}`,
    noAnswer: "The server has said nothing of this robot.",
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
    status: {
      sent: "sent",
      accepted: "accepted",
      started: "started",
      done: "done",
      failed: "failed",
      expired: "expired",
      cancelled: "cancelled",
      refused: "refused",
      unanswered: "no answer",
    } satisfies Record<RunStatus, string>,
  },

  acts: {
    asked: (request: AnyRequest | { kind: "stream" }): string => asked(request),
    running: (name: string): string => `Running: ${name}`,
    othersDo: (kind: string, name: string): string => `Running: ${name === "" ? (kinds[kind] ?? kind) : name}`,
    back: "Back to where it was",
    dismiss: "Hide",
    unanswered: "Nobody here knows whether the robot was asked. Look at it before you ask again.",
    held: (name: string): string => `${name} has control.`,
    fault: "The robot reports a fault.",
    busy: "It is doing something else. Cancel that first.",
    streaming: "It is following your targets.",
    postures: "Postures",
    expressions: "Expressions",
    behaviours: "Behaviours",
    speech: "Speech",
    pose: "Move to a pose",
    place: "Go to a place",
    look: "Look at a point",
    stiffness: "Stiffness",
    speed: "Speed",
    strength: "Strength",
    say: "What it is to say",
    sayIt: "Say it",
    language: "Language",
    ownLanguage: "its own",
    languages: { en: "English", sk: "Slovak", de: "German", fr: "French", es: "Spanish", id: "Indonesian" },
    axes: ["x", "y", "z"] as const,
    turns: ["roll", "pitch", "yaw"] as const,
    frame: "Frame",
    here: "Where it is now",
    way: "How it goes there",
    ways: { plan: "Around obstacles", direct: "Shortest turns", straight: "Straight line" },
    moveThere: "Move there",
    lookNote: "Seen from the robot: x is ahead, y to its left, z up.",
    lookThere: "Look there",
    heading: "heading",
    placeNote: "Point at a place on the plan, or type it. Without a heading it stands as it arrives.",
    goThere: "Go there",
    whereItIs: "Where it is now",
    joint: "Joint",
    allJoints: "All joints",
    set: "Set",
    letGo: "Let go",
    holdFully: "Hold fully",
    limpWarning: "A robot that stands falls when its joints go limp. Let it sit or crouch first, or hold it.",
    holdsFully: "The robot says: every joint holds fully.",
    holdsLess: (which: string): string => `The robot says that these hold with less: ${which}.`,
    stiffnessUnknown: "The robot has not said yet how its joints hold.",
  },

  evidence: {
    title: "What became of the last commands",
    none: "Nothing has been asked for from this page yet.",
    what: "Command",
    column: { accepted: "accepted", started: "started", observed: "observed", ended: "ended" },
    heard: { page: "here", device: "by the robot", cloud: "by the cloud" } satisfies Record<Channel, string>,
    seenBy: { motion: "it moved", state: "its own word" } satisfies Record<SeenBy, string>,
    end: ({ status, request, why }: Line): string => {
      const because = (texts.joints.ended as Readonly<Record<string, string>>)[why];
      return request.kind === "stream" && because !== undefined ? because : texts.movements.status[status];
    },
    explained: "Since the click, on this computer's clock. Observed: the first telemetry in which something moved.",
  },

  watching: {
    title: "Camera",
    choose: "What to look through",
    own: (camera: string): string => `The robot's ${camera}`,
    from: (label: string, camera: string): string => `From the room: ${label} (${camera})`,
  },

  keyframes: {
    title: "Keyframes",
    editAs: "Edit as keyframes",
    noRobot: "The drawing of the robot type. No robot moves.",
    runsOnDevice: "No robot is chosen here: save it, and run it from the movement's own page or from a robot's.",
    open: "New movement from keyframes",
    edit: (name: string): string => `Open the keyframes of ${name}`,
    editShort: "Keyframes",
    waiting: "Waiting for the robot to say what it is and how it stands …",
    twin: "Movement",
    twinLabel: "The movement in three dimensions, on a drawing of the robot",
    previewing: "Preview: the robot does not move",
    numberOf: (index: number, count: number): string => `Keyframe ${index} of ${count}`,
    ghost: "The robot as it is now",
    noGhost: "The robot as it is now is not known",
    timeline: "Timeline",
    play: "▶ Preview",
    pause: "❚❚ Pause",
    previewOnly: "On this drawing only.",
    seconds: (value: number): string => `${value.toFixed(2)} s`,
    ofSeconds: (value: number, last: number): string => `${value.toFixed(2)} s of ${last.toFixed(2)} s`,
    tick: (value: number): string => `${value} s`,
    playhead: "Moment of the preview",
    marker: (index: number, wrong: boolean): string => `Keyframe ${index}${wrong ? ", something is wrong there" : ""}`,
    add: "Add",
    addMeasured: "Add the robot's pose",
    duplicate: "Duplicate",
    remove: "Delete",
    notLive: "The robot's pose is not known now.",
    timelineKeys: "Drag a keyframe, or move it by the arrow keys: 0.1 s, with Shift 1 s, with Alt 0.01 s. Ctrl+Z undoes.",
    undo: "Undo",
    redo: "Redo",
    checks: "Checks",
    checked: (count: number): string => (count === 0 ? "" : count === 1 ? "1 thing to mend" : `${count} things to mend`),
    allGood: "✓ Within all limits of the joints",
    at: (index: number): string => `Keyframe ${index}`,
    robotChecks: "What is in the robot's way it looks at itself, before it moves and while it does.",
    mendAll: "Give all of them the time they need",
    more: (count: number): string => `And ${count} more.`,
    problem: ({ what }: Problem, joint: string): string => {
      switch (what.kind) {
        case "range":
          return `${joint} can only go from ${deg(what.lower_rad)} to ${deg(what.upper_rad)}.`;
        case "narrowed":
          return `${joint} can only go from ${deg(what.lower_rad)} to ${deg(what.upper_rad)} where ${what.by} is then.`;
        case "mirrored":
          return `${joint} and ${what.of} are moved by one motor, and cannot be apart.`;
        case "unknown-joint":
          return `This robot has no joint ${joint}.`;
        case "unknown-name":
          return `This robot does not know “${what.name}”.`;
        case "cannot":
          return `This robot cannot do that: ${texts.keyframes.deeds[what.deed].toLowerCase()}.`;
        case "too-fast":
          return `${joint} would have to be too fast to get here: its ${what.by} is limited.`;
        case "times":
          return "Times must rise from keyframe to keyframe.";
        case "late-joint":
          return `${joint} is set here first; where it begins is not known.`;
        case "too-long-text":
          return "The text is too long: 500 characters at most.";
      }
    },
    mend: ({ what }: Problem): string => {
      switch (what.kind) {
        case "too-fast":
          return `Stretch to ${what.needs_s.toFixed(2)} s`;
        case "range":
        case "narrowed":
          return "Bring it inside";
        case "times":
          return "Put them in order";
        case "late-joint":
          return "Begin there, too";
        case "mirrored":
        case "unknown-joint":
        case "unknown-name":
        case "cannot":
        case "too-long-text":
          return "Take it out";
      }
    },
    number: (index: number): string => `Keyframe ${index}`,
    first: "It begins here, at 0 s. The robot goes to this pose first, at half speed.",
    time: "At [s]",
    lasts: "After the one before [s]",
    shifting: "those after it move along",
    takePose: "Take the robot's pose now",
    joints: "Joints at this keyframe",
    here: "is here",
    passes: "passes on its way",
    hereFor: (joint: string): string => `${joint} is set at this keyframe`,
    deedsTitle: "And there …",
    deedsNote: "Done one after the other; the time of the keyframes stands still meanwhile.",
    nothing: "–",
    deedMark: "✦",
    deeds: {
      posture: "Take a posture",
      behaviour: "Run a behaviour",
      express: "Show an expression",
      say: "Say",
      drive: "Drive",
      go_to: "Go to a place in the room",
    } satisfies Record<Deed, string>,
    forward: "forward [m/s]",
    turn: "turn [°/s]",
    duration: "for [s]",
    x: "x [m]",
    y: "y [m]",
    yaw: "looking to [°]",
    script: "Save and run",
    name: "Name",
    description: "What it does",
    nameNote: "Letters, digits, - and _.",
    save: "Save",
    saving: "Saving …",
    saveAndRun: "Save and run",
    run: "Run on the robot",
    speed: "Speed",
    percent: (share: number): string => `${Math.round(share * 100)} %`,
    mendFirst: "Mend what is wrong before it is run.",
    tooLong: "This is more than a script can hold: take out keyframes, or joints that need not be set.",
    savedAs: (version: number): string => `Saved as version ${version}.`,
    newer: (version: number): string => `Somebody has saved version ${version} meanwhile. Nothing of yours is lost.`,
    deleted: "This movement has been deleted meanwhile. Nothing of yours is lost.",
    saveOver: "Save mine over it",
    seeScript: "The script that is written",
    record: "Record",
    recordNote: "Records the joints, whoever moves the robot: its own page in another tab, somebody else, a movement. A drive is not recorded.",
    startRecording: "● Record",
    stopRecording: "■ End the recording",
    recordingGap: "Nothing is heard of the robot. The recording goes on when it is back.",
    recorded: (samples: number, lasts: number, gaps: number): string =>
      `${samples} poses in ${lasts.toFixed(1)} s${gaps === 0 ? "" : gaps === 1 ? ", with a gap" : `, with ${gaps} gaps`}`,
    gapNote: "In the yellow stretch nothing was heard of the robot: there the movement goes straight on.",
    curves: (count: number): string => `${count} joints that moved, over time`,
    trimFrom: "Begin",
    trimTo: "End",
    tolerance: "As near as",
    useThem: (count: number): string => `Use these ${count} keyframes`,
    discard: "Discard the recording",
    restored: "This is your draft of last time, which is not saved yet.",
    revert: "Back to what is saved",
    beginAnew: "Begin anew",
    unkept: "This browser keeps no drafts now: save before you leave.",
    byHand: (name: string): string => `The script of “${name}” is more than keyframes: somebody wrote or changed it by hand.`,
    toCode: "Open it in the code editor",
  },

  list: {
    search: "Search",
    searchExample: "Name, type or room",
    show: "Show",
    kinds: { all: "All", robots: "Robots", sensors: "Room devices" },
    whose: "Whose",
    whoses: { all: "Anybody’s", mine: "Mine", shared: "Shared with me" },
    onlyTrouble: "Only what needs a look",
    shown: (shown: number, all: number): string => (shown === all ? `${all} devices` : `${shown} of ${all} devices`),
    nothing: "No device fits. Clear the search, or show all.",
    clear: "Show all",
    robots: "Robots",
    sensors: "Room devices",
    plan: "Plan",
    planOf: (space: string): string => `Plan of ${space}`,
  },

  plan: {
    title: "Plan",
    /** Of somebody on the plan, for whose name there is no room there. */
    letter: (index: number): string => String.fromCharCode(65 + (index % 26)),
    empty: "No device of this room tells where it or anybody else is. A room device of the kind “perception” does.",
    waiting: "Waiting for the room to say what it sees …",
    label: (count: number): string => `Plan of the room with ${count === 1 ? "1 robot or person" : `${count} robots and people`}`,
    stale: (age: string): string => `Nothing new for a while. What is drawn is the last that was heard, ${age}.`,
    person: (name: string): string => (/^person(-\d+)?$/.test(name) ? name.replace("person", "Person").replace("-", " ") : name),
    seen: (age: string): string => `seen ${age}`,
    unseen: (s: number): string => `unseen for ${Math.round(s)} s`,
    who: "Robots and people",
    nobody: "Nobody is seen.",
    column: { name: "Who", place: "Place (m)", heading: "Heading", seen: "Seen" },
    sensors: "What hangs in the room",
    place: (x: string, y: string): string => `${x}, ${y}`,
    key: { taken: "taken", unknown: "not seen yet", trail: "the last half minute" },
    heading: (degrees: string): string => degrees,
    metre: "1 m",
  },

  room: {
    measuring: "Measuring",
    nothingYet: "Nothing has come yet.",
    values: (stream: string): string => `Values: ${stream}`,
    name: "Name",
    value: "Value",
    late: (age: string): string => `Last value ${age}`,
    span: "How far back",
    spans: { "10min": "10 min", "1h": "1 h", "24h": "24 h" },
    limits: (low: string | null, high: string | null, unit: string): string => {
      if (low === null) return high === null ? "" : `Green: up to ${high} ${unit}, as it should be.`;
      if (high === null) return `Green: from ${low} ${unit}, as it should be.`;
      return `Green: ${low} to ${high} ${unit}, as it should be.`;
    },
    chart: (label: string, low: string, high: string, unit: string): string => `Plot of ${label}: between ${low} and ${high} ${unit}`,
    chartEmpty: (label: string): string => `Plot of ${label}, still without a value`,
    noHistory: (why: string): string => `What was measured before could not be read: ${why}`,
    judged: { well: "as it should be", warning: "look at it", bad: "out of its limits" },
    state: {
      open: ["Open", "Shut"],
      present: ["Motion", "Nothing moves"],
    } as Readonly<Record<string, readonly [string, string]>>,
    yesNo: ["Yes", "No"] as const,
    since: (when: string): string => `since ${when}`,
    sinceLonger: (when: string): string => `since ${when} at the latest`,
    stopFirst: "It is stopped. Reset Stop first.",
    away: "It is not connected.",
    watchOnly: "You may watch this device, not use it. Ask its owner.",
  },

  camera: {
    title: (name: string): string => `Camera: ${name}`,
    start: "Show live pictures",
    stop: "Stop pictures",
    shot: "Take one picture",
    taking: "Taking …",
    off: "Pictures come only while you ask for them.",
    waiting: "Waiting for the first picture …",
    stalled: (age: string): string => `The last picture came ${age}`,
    label: (name: string): string => `Picture of the camera ${name}`,
    live: (width: number, height: number, rate: string): string => `Live, ${width} × ${height}, ${rate} pictures a second`,
    still: (width: number, height: number, age: string): string => `One picture, ${width} × ${height}, taken ${age}`,
    stopped: (age: string): string => `Stopped. The last picture came ${age}.`,
    undecodable: "A picture came that this browser cannot draw.",
  },

  depth: {
    title: "Depth picture",
    shot: "Take a depth picture",
    again: "Take another",
    none: "Take a picture to see how far everything is.",
    label: (near: string, far: string): string =>
      `Depth picture in false colours, from ${near} to ${far} m. Arrow keys move the point that is read.`,
    read: (m: string): string => `${m} m`,
    readNothing: "nothing within reach",
    hint: "Point at a place, or use the arrow keys, to read its distance.",
    noReading: "Grey: nothing within reach.",
    taken: (width: number, height: number, age: string): string => `${width} × ${height}, taken ${age}`,
  },

  scan: {
    title: "Scan",
    shot: "Take a scan",
    label: (nearest: string): string => `What the lidar sees, drawn to scale. Nearest: ${nearest} m.`,
    labelEmpty: "What the lidar sees; nothing has come yet",
    live: "Arcs: the nearest thing in each direction, live.",
    points: (count: number, age: string): string => `Dots: ${count} beams of the scan taken ${age}.`,
    noPoints: "Take a scan to see every beam.",
    ahead: "ahead",
    nearest: "Nearest",
  },

  settings: {
    title: "Settings",
    now: "now",
    slider: (label: string): string => `${label}: set to`,
    applying: "Being set …",
    applied: (value: string): string => `Applied: ${value}`,
    ends: { level: ["Off", "On"], opening: ["Shut", "Open"] } as Readonly<Record<string, readonly [string, string]>>,
    refused: (why: string): string => `Not set: ${why}`,
  },

  gather: {
    title: "Gathering",
    explain: "Have it measure faster, or slower, for a while. Everybody who watches it gets what comes, and it is stored.",
    rate: "Times a second",
    time: "For",
    times: { "10": "10 s", "60": "1 min", "600": "10 min", "3600": "1 h" },
    start: "Start gathering",
    stop: "Stop gathering",
    once: "Measure once",
    running: (percent: number): string => `Gathering, ${percent} % done`,
    rest: "Not gathering: it measures at its own pace.",
    badRate: "The rate is between 0.001 and 50 a second.",
    onceTaken: (age: string): string => `Measured once, ${age}`,
    pace: (stream: string, rate: string): string => `${stream}: ${rate} a second`,
    busy: "It is doing something else.",
  },

  files: {
    title: "Captured files",
    none: "Nothing has been captured yet.",
    take: (name: string): string => `Capture ${name}`,
    taking: "Capturing …",
    download: "Download",
    downloadNamed: (name: string): string => `Download ${name}`,
    size: (bytes: number): string => (bytes < 1_000_000 ? `${Math.max(1, Math.round(bytes / 1000))} kB` : `${(bytes / 1e6).toFixed(1)} MB`),
    unreadable: "The file could not be read here. Download it from the list of captured files.",
  },

  time: (ms: number): string => timeOfDay.format(ms),
  day: (ms: number): string => dayOfMonth.format(ms),
  dayAndTime: (ms: number): string => dayAndTime.format(ms),
  sinceWhen: (ms: number): string => (Date.now() - ms < 12 * 3_600_000 ? timeOfDay.format(ms) : dayAndTime.format(ms)),

  events: { title: "Events", none: "Nothing to report.", faults: "Faults" },

  care: {
    all: "Health",
    title: {
      health: (name: string): string => `Health of ${name}`,
      times: (name: string): string => `Times of ${name}`,
    },
    explained: "The worst first: what each device says of itself, and what the server finds in its measurements.",
    operate: "Device",
    pages: (label: string): string => `Pages of ${label}`,
    spaces: "Spaces",
    everywhere: "All spaces",
    devices: "Devices and their health",
    health: { ok: "Well", unknown: "Not heard", warning: "Look at it", fault: "Fault" } satisfies Record<HealthState, string>,
    chip: (count: number): string => (count === 0 ? "Health" : count === 1 ? "1 open fault" : `${count} open faults`),
    open: (count: number): string => (count === 0 ? "No open fault." : count === 1 ? "1 open fault." : `${count} open faults.`),
    counts: (parts: readonly string[]): string => parts.join(" · "),
    which: { all: "All", look: "Only what needs a look" },
    allWell: "Nothing needs a look.",
    nothing: { ok: "Nothing is wrong.", unknown: "Nothing is heard of it, so nobody can say how it is." },
    since: (when: string): string => `since ${when}`,
    failed: (why: string): string => `The server could not be asked: ${why}`,
    faults: "Faults",
    whichFaults: "Which faults",
    faultLists: { open: "Open", past: "Past" },
    noFaults: { open: "No open fault.", past: "No past fault." },
    older: "Show older ones",
    severity: { error: "Fault", warning: "Warning", info: "Note" } satisfies Record<Severity, string>,
    kind: {
      reported: "Told by the device",
      silent: "Silent",
      level: "Beyond a limit",
      trend: "On its way to a limit",
      change: "Changed",
      outlier: "Unusual",
    } as Readonly<Record<string, string>>,
    agreement: {
      unstored: "The device says so; the server has not stored it yet.",
      ended: "The device does not say so any more; the server has not cleared it yet.",
      unheard: "From the server's record: the device cannot be heard now, so it may have changed.",
    },
    saidSince: (age: string): string => `Raised ${age}, by the device's clock.`,
    life: {
      title: "Life of this fault",
      raised: "Raised",
      seen: (by: string): string => `Seen by ${by}`,
      unseen: "Nobody has said yet that they have seen it",
      neverSeen: "It ended before anybody said that they had seen it",
      cleared: "Cleared",
      open: "Still open",
      source: {
        device: "noticed by the device",
        detector: "found by the server in what the device measures",
        cloud: "found by the server: nothing is heard of the device",
      } satisfies Record<Fault["source"], string>,
      count: (count: number): string => (count === 1 ? "for the first time" : `time number ${count}`),
      worsened: (times: number): string => (times === 0 ? "" : times === 1 ? "got worse once" : `got worse ${times} times`),
    },
    acknowledge: "I have seen it",
    saving: "Saving …",
    noUndo: "Everybody is told who has seen it. This cannot be taken back.",
    watchOnly: "Who only watches cannot say that it was seen.",
    showTrend: "Show the trend",
    around: "What happened around it",
    nothingAround: "Nothing is on record from that time.",
    event: {
      "fault-raised": "Fault raised",
      "fault-acknowledged": "Fault seen",
      "fault-worsened": "Fault got worse",
      "fault-cleared": "Fault cleared",
    } as Readonly<Record<string, string>>,
    watched: "What is watched",
    columns: ["Measurement", "Now", "Usually", "Should be"],
    span: (low: string | null, high: string | null): string => {
      if (low === null) return high === null ? "–" : `up to ${high}`;
      return high === null ? `from ${low}` : `${low} to ${high}`;
    },
    storedAt: (when: string): string => `As stored ${when}`,
    nothingWatched: "Nothing of this device is watched yet. What it measures shows here once it is stored.",
    others: "Other measurements",
    pickOther: "Show the trend of",
    noOther: "Choose …",
    print: "Print a report",
  },

  times: {
    all: "Times",
    explained: "How long things take, each measured on one clock. What is drawn was measured; dashed lines are what papers have printed.",
    path: {
      "command-started": "Command → device has started",
      "command-answered": "Command → device has answered",
      "received-started": "At the device: received → started",
      "operator-device": "This page → device → back",
      "operator-cloud": "This page → server → back",
      "device-cloud": "Device → server → back",
    } satisfies Record<Path, string>,
    transport: {
      mqtt: "MQTT",
      websocket: "MQTT over WebSocket",
      http: "HTTP",
      "http-poll": "HTTP polling",
      xmpp: "XMPP",
    } satisfies Record<Transport, string>,
    line: (device: string, transport: string, path: string | null): string => `${device}, ${transport}${path === null ? "" : `: ${path}`}`,
    filters: "What to show",
    part: "Part",
    allParts: "All parts",
    via: "Transport",
    allTransports: "All transports",
    device: "Device",
    allDevices: "All devices",
    span: "How far back",
    spans: { hour: "Hour", day: "Day", week: "Week", month: "Month" },
    axis: "Along",
    axes: { order: "Samples", time: "Time" },
    scale: "Scale",
    scales: { log: "Logarithmic", linear: "Linear" },
    overTime: "Response times",
    shares: "How many were how quick",
    chart: (what: string, lines: number, samples: number): string => `${what}: ${samples} samples in ${lines} ${lines === 1 ? "line" : "lines"}. The table has the figures.`,
    sampleAxis: "sample",
    milliseconds: "ms",
    percent: "%",
    none: "No sample in this time.",
    how: "Samples come by themselves: of every command when it ends, and while a robot is operated from this console. To have some at once, measure here, on the page of a device.",
    figures: "In figures",
    columns: ["Line", "Samples", "Median", "Mean", "95 %", "99 %", "Greatest"],
    more: (stored: number): string => `${stored} were counted in this time; the newest are drawn.`,
    csv: "Save as CSV",
    csvName: "telescope-times.csv",
    failed: (why: string): string => `Times could not be read: ${why}`,
    publishedTitle: "Published averages",
    published: {
      "ur5-http": "HTTP, average",
      "ur5-xmpp": "XMPP, average",
      "telescope-slowest": "Reaction of robots, slowest average",
      "telescope-fastest": "Reaction of robots, quickest average",
      "telescope-client-worst": "Room client, longest",
      "telescope-client": "Room client, average",
      "telescope-client-best": "Room client, shortest",
    } as Readonly<Record<string, string>>,
    publishedNone: "The papers have printed nothing for this part.",
    source: (figure: string, source: string): string => `${figure} (${source})`,
    measure: "Measure now",
    measureExplained: (ways: readonly string[]): string =>
      `20 times each, one after the other; nothing moves: ${ways.join("; ")}.`,
    ways: {
      cloud: "ask the server over HTTP whether it is well",
      broker: "ping the broker over this page's own connection",
      device: "have the device measure once, and wait for its values",
    } satisfies Record<WayToMeasure, string>,
    measuring: (way: string, done: number, of: number): string => `${done} of ${of}: ${way}`,
    stop: "End measuring",
    measureDone: (count: number): string => `${count} samples were measured here.`,
    notStored: "What was measured here is not stored yet.",
    store: "Store it",
    robotNote: "How long the robot itself takes is measured while it is operated: each command and each target counts.",
    viewer: "Who only watches measures for this page alone; nothing is stored.",
    ended: (why: string): string => `It ended early: ${why}`,
  },

  trend: {
    title: "Trend",
    spans: { "10min": "10 min", hour: "Hour", day: "Day", week: "Week", month: "Month" },
    view: "Show as",
    views: { chart: "Chart", table: "Table" },
    keys: "Point at the chart, or focus it and press the arrow keys, to read it.",
    nothing: "Nothing was measured here.",
    at: (when: string, mean: string, band: readonly [string, string] | null): string =>
      band === null ? `${when}: ${mean}` : `${when}: ${mean} on average, from ${band[0]} to ${band[1]}`,
    notHeard: "Nothing has been heard of it since this page was opened.",
    learning: "What is usual has still to be learnt: that takes ten minutes of measuring.",
    usual: (low: string, high: string): string => `Usually ${low} to ${high}: between the dashed lines.`,
    slope: (rises: boolean, perMinute: string): string => `It ${rises ? "rises" : "falls"} by ${perMinute} a minute.`,
    limitIn: (time: string): string => `At this pace it meets its limit in about ${time}.`,
    faults: "Faults in this time",
    fault: (kind: string, from: string, to: string | null): string => `${kind}: ${to === null ? `since ${from}` : `${from} to ${to}`}`,
    rows: (shown: number, all: number): string => (shown === all ? `${all} values, the newest first.` : `The newest ${shown} of ${all} values.`),
    columns: ["When", "Mean", "Least", "Greatest"],
  },
};

const kinds: Readonly<Record<string, string>> = {
  run_movement: "a movement",
  move_joints: "moving its joints",
  move_pose: "moving to a pose",
  say: "speaking",
  express: "an expression",
  take_posture: "a posture",
  run_behaviour: "a behaviour",
  set_stiffness: "setting its stiffness",
  look_at: "looking at a point",
  drive: "driving",
  go_to: "going to a place",
};

/** What was asked for, in a few words. */
function asked(request: AnyRequest | { kind: "stream" }): string {
  const metres = (values: readonly number[]): string => values.map((value) => value.toFixed(2)).join(", ");
  switch (request.kind) {
    case "stream":
      return "Steering";
    case "run_movement":
    case "run_behaviour":
    case "express":
    case "take_posture":
      return request.name;
    case "move_joints":
      return "Joint positions";
    case "move_pose":
      return `Pose at ${metres(request.position_m)} m`;
    case "say":
      return `“${request.text.length > 40 ? `${request.text.slice(0, 40)} …` : request.text}”`;
    case "set_stiffness":
      return request.value === 0 ? "Limp" : `Stiffness ${Math.round(request.value * 100)} %`;
    case "look_at":
      return `Look at ${metres(request.position_m)} m`;
    case "drive":
      return "Drive";
    case "go_to":
      return `Go to ${metres([request.x_m, request.y_m])} m`;
    case "gather":
      return "Gathering";
    case "shoot":
      return "Measuring once";
    case "capture":
      return `Capture ${request.name}`;
    case "set_control":
      return `Set ${request.control}`;
  }
}
