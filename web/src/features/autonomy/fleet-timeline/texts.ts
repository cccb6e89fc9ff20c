import type { MarkKind, TimeRange } from "../model/fleet-timeline";

export const texts = {
  title: "Timeline",
  explained: "Who controlled which robot, and when. Times are local.",
  range: "Time range",
  ranges: { hour: "1 hour", shift: "12 hours", day: "24 hours", week: "7 days" } satisfies Record<TimeRange, string>,
  earlier: "Earlier",
  later: "Later",
  now: "Now",
  view: "Display",
  views: { chart: "Chart", table: "Table" },
  noRobots: "There are no robots yet. Add one, and its sessions appear here.",
  row: (label: string, sessions: number, marks: number): string =>
    `${label}: ${sessions} ${sessions === 1 ? "session" : "sessions"}, ${marks} ${marks === 1 ? "event" : "events"}. The table contains them.`,
  rowFailed: (reason: string): string => `Not loaded: ${reason}`,
  incomplete: (labels: string): string => `There is more than this page reads, so the oldest entries are missing: ${labels}. Choose a shorter time range.`,
  person: "Person",
  action: "Action",
  mark: { stop: "Stop", fault: "Fault", handover: "Change of control" } satisfies Record<MarkKind, string>,
  unknownHolder: "Unknown operator",
  interval: (who: string, from: string, to: string): string => `${who}, ${from} – ${to}`,
  marked: (kind: string, at: string, message: string): string => `${kind}, ${at}: ${message}`,
  task: (holder: string, task: string): string => `${holder}: ${task}`,
  lasts: "now",
  empty: "Nothing in this time range.",
  table: "Sessions and events, newest first",
  columns: ["Time", "Robot", "What", "Until"],
};
