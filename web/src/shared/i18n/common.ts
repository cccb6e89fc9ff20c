/** Texts used by several features. */
import type { Role } from "../api/sharing";
import type { Mode } from "../mqtt/protocol.generated";

export const common = {
  loading: "Loading…",
  tryAgain: "Try again",
  loadFailed: (reason: string): string => `Loading failed. ${reason}`,
  pageFailed: "This page failed to load. Check your connection to the server.",
  chartFailed: "The chart failed to load.",
  never: "never",
  secondsUnit: "s",
  allDevices: "All devices",
  deviceMissing: "This device does not exist, or you have no access to it.",
  yesNo: ["Yes", "No"] as const,
  /** Labels for the values of boolean measurements: true, false. */
  booleanState: {
    open: ["Open", "Closed"],
    present: ["Motion detected", "No motion"],
  } as Readonly<Record<string, readonly [string, string]>>,
  role: { owner: "Owner", operator: "Operator", viewer: "Viewer" } satisfies Record<Role, string>,
  mode: {
    idle: "idle",
    streaming: "following an operator",
    action: "running an action",
    holding: "holding position",
    stopped: "stopped",
    fault: "fault",
  } satisfies Record<Mode, string>,

  form: {
    accountName: "Account name",
    cancel: "Cancel",
  },
  duration: {
    never: "until I revoke it",
    hour: "1 hour",
    workday: "8 hours",
    day: "1 day",
    week: "7 days",
    month: "30 days",
    date: "until a date…",
    keep: "unchanged",
    pick: "Until",
    past: "Choose a time in the future.",
  },
  copy: {
    button: "Copy",
    copied: "Copied.",
    manually: "This browser does not allow copying here. The text is selected: press Ctrl+C or ⌘C.",
  },
  createdLink: {
    label: "Invitation link",
    created: "The link is ready. Copy it now: it is shown only once.",
    close: "Done",
  },
};
