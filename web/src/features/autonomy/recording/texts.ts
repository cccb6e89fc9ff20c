import type { EventGroup, GapCause, Source } from "../model/recording";

/** Time since the start of a session: 1:05.2, or 1:02:05.2. */
function clock(seconds: number, digits = 1): string {
  const scale = 10 ** digits;
  const whole = Math.round(seconds * scale);
  const rest = whole % (60 * scale);
  const minutes = Math.floor(whole / (60 * scale));
  const tail = (rest / scale).toFixed(digits).padStart(digits === 0 ? 2 : digits + 3, "0");
  if (minutes < 60) return `${minutes}:${tail}`;
  return `${Math.floor(minutes / 60)}:${String(minutes % 60).padStart(2, "0")}:${tail}`;
}

const ranges = (numbers: readonly number[]): string => {
  const parts: [number, number][] = [];
  for (const number of numbers) {
    const last = parts.at(-1);
    if (last?.[1] === number - 1) last[1] = number;
    else parts.push([number, number]);
  }
  return parts.map(([first, last]) => (first === last ? String(first) : `${first}–${last}`)).join(", ");
};

/** Segments by their minute, which is counted from 1. */
const minutes = (segments: readonly number[]): string => `${segments.length === 1 ? "minute" : "minutes"} ${ranges(segments.map((segment) => segment + 1))}`;

export const texts = {
  clock,
  back: "All sessions of this robot",
  by: (holder: string | null, start: string): string => `${holder ?? "Unknown operator"}, ${start}`,
  manual: "Manual control",
  withoutNumber: "The address names no session. Open a session from the robot's autonomy page.",
  none: "No recording of this session is stored.",
  noneHint:
    "The agent uploads each minute after it has ended, and this page shows it a few seconds later. Otherwise recording was off (see the agent's configuration), or the recording was deleted.",
  incomplete: "The agent is still recording or uploading this session. New parts appear by themselves.",
  mayArrive: "The agent may still have parts of this session. It uploads them when it is connected.",
  check: "Check again",
  gaps: {
    title: (count: number): string => (count === 1 ? "One time without data" : `${count} times without data`),
    more: (count: number): string => `${count} more are on the timeline.`,
    cause: {
      waiting: "The agent has this part and uploads it when its link permits.",
      lost: "The agent does not have this part any more: it was deleted before its upload, or has no rows.",
      unknown: "This part is not stored. If the agent has it, it uploads it when its link permits.",
      unrecorded: "The agent could not record, for instance because its disk was full.",
      empty: "The agent recorded no rows: it was not running, or could not write them in time.",
    } satisfies Record<GapCause, string>,
  },
  failed: (numbers: readonly number[], reason: string): string => `Not loaded: ${minutes(numbers)} of the recording. ${reason} If the overview of this time is stored, it is shown.`,
  truncated: (number: number): string => `The file of minute ${number + 1} ends early. Rows after its end are missing; the overview shows five samples a second there.`,

  remove: "Delete recording",
  removeQuestion: "Delete all rows, images and episodes of this session for everyone?",
  removing: "Deleting…",
  cancel: "Cancel",

  source: { operator: "Operator", movement: "Movement", hold: "Hold", stop: "Stop" } satisfies Record<Source, string>,
  noData: {
    gap: "No data at this time",
    loading: "Loading…",
    failed: "This part failed to load",
  },

  twin: {
    title: "Robot at the cursor",
    label: "3D view of the robot at the cursor. Drag to rotate, scroll to zoom.",
    waiting: "Waiting for the robot's model. The agent publishes it when it is connected.",
    reset: "Reset view",
    ghost: "Ghost",
    ghosts: { requested: "Requested", applied: "Applied", none: "None" },
    legend: "Solid: measured. Blue: the ghost, where it differs.",
    seenLegend: "Solid: what the operator saw. Blue: measured at the cursor, where it differs.",
    comparedLegend: "Solid: this session. Blue: the other session, where it differs.",
    seenTag: (age: string): string => `What the operator saw, ${age} old`,
  },

  seen: {
    show: "Show what the operator saw",
    age: (age: string): string => `${age} before this command`,
    hide: "Show the robot at the cursor",
    none: "This row has no command of an operator.",
    explained: "The telemetry that the operator's page showed when this command was sent.",
  },

  row: {
    title: "Values at the cursor",
    loading: "The rows of this minute are loading. Until then, the values come from the overview.",
    facts: {
      source: "Source",
      mode: "Mode",
      epoch: "Epoch",
      sequence: "Period",
      limits: "Limits",
      age: "Loop age",
      setpoint: "Setpoint",
      twist: "Base",
    },
    noLimits: "none",
    noSetpoint: "none",
    twist: (forward: number, left: number, turn: string): string => `${forward.toFixed(2)} m/s forward, ${left.toFixed(2)} m/s left, ${turn}/s`,
    columns: ["Joint", "Measured", "Requested", "Commanded", "Applied"],
    table: "Joint values at the cursor",
  },

  time: {
    title: "Timeline",
    play: "Play",
    pause: "Pause",
    speed: "Speed",
    speedOf: (speed: number): string => `${speed}×`,
    zoomIn: "Zoom in",
    zoomOut: "Zoom out",
    earlier: "Earlier",
    later: "Later",
    all: "Whole session",
    cursor: "Cursor",
    at: (seconds: number, total: number): string => `${clock(seconds)} of ${clock(total)}`,
    help: "Drag on the timeline to search. Arrow keys move by 1 s, with Shift by 10 s, with Alt by one row; Page Up and Page Down by 1 min. The wheel zooms.",
    legend: "Colours of the timeline",
    gap: "No data",
  },

  plot: {
    title: "Joint positions",
    label: "Plot of the measured and applied joint positions. The table of values shows the numbers at the cursor.",
    legend: "Measured: solid. Applied: dashed.",
    comparedLegend: "Measured in this session: solid. In the other session: dashed.",
    joints: "Joints to plot",
    unit: "°",
  },

  images: {
    title: (topic: string): string => `Camera ${topic.replace(/^\/frames\//, "")}`,
    label: (topic: string): string => `Image of ${topic.replace(/^\/frames\//, "")} at the cursor`,
    none: "No image at this time",
    loading: "The images of this minute are loading.",
    age: (age: string): string => `Recorded ${age} before the cursor`,
    undecodable: "This image cannot be displayed.",
  },

  movement: {
    title: "Replay on a robot",
    explained: "Saves the applied positions of the episode at the cursor, or of the whole session, as a movement. It first moves to the start on a planned path. All limits of the robot apply. While the agent was late, the last position is kept.",
    part: (name: string, start: number, end: number): string => `${name}, ${clock(start)} – ${clock(end)}`,
    session: "Whole session",
    name: "Name of the movement",
    nameNote: "Letters, digits, _ and -.",
    save: "Save as movement",
    saving: "Saving…",
    saved: (keyframes: number, degrees: string): string => `Saved with ${keyframes} positions; it deviates from the recording by at most ${degrees}.`,
    open: "Open the movement",
    exists: "A movement with this name exists. Choose another name.",
    description: (label: string, by: string): string => `${label === "" ? "Recorded session" : label}: ${by}`,
    errors: {
      gap: "Data is missing in this part. Choose an episode without missing data.",
      base: "The base moved in this part. Only the joints can be replayed: choose an episode without driving.",
      empty: "This part has no rows.",
      "too-long": "This part is too long for one movement: at most ten minutes, and shorter if the motion is fast. Choose a shorter episode.",
    },
  },

  events: {
    title: "Events",
    none: "No event in the visible part of the timeline.",
    explained: "Events in the visible part of the timeline.",
    more: (count: number): string => `${count} more are further from the cursor: zoom in to see them.`,
    omitted: (count: number): string => `${count} less severe events are listed when their minute is loaded.`,
    unknown: (count: number): string => `Of ${count} ${count === 1 ? "minute" : "minutes"} by an older agent, events are listed after the cursor has been there.`,
    group: { stop: "Stop event", fault: "Fault", handover: "Handover", command: "Command", other: "Other event" } satisfies Record<EventGroup, string>,
  },

  episodes: {
    title: "Episodes",
    explained: "An episode is one attempt at a task. A first rating marks the whole session; then split it or drag its ends on the timeline.",
    readOnly: "You may read episodes. Operators and owners of the robot may change them.",
    none: "No episode is marked.",
    success: "Success",
    failure: "Failure",
    outcome: { success: "success", failure: "failure", none: "not rated" },
    split: "Split at cursor",
    startHere: "Start at cursor",
    endHere: "End at cursor",
    remove: "Delete",
    removeOf: (number: number): string => `Delete episode ${number}`,
    removeQuestion: "Delete this episode?",
    label: "Label",
    note: "Note",
    name: (number: number, label: string): string => (label === "" ? `Episode ${number}` : `${number}: ${label}`),
    range: (start: number, end: number): string => `${clock(start)} – ${clock(end)}`,
    startOf: (number: number): string => `Start of episode ${number}`,
    endOf: (number: number): string => `End of episode ${number}`,
    selected: (number: number): string => `Selected: episode ${number}`,
    rate: "Rate the episode at the cursor",
    state: {
      saved: "",
      saving: "Saving…",
      conflict: "Another person changed the episodes at the same time. Their list is shown now; your last change was not saved. Make it again if it is still needed.",
    },
    failed: (reason: string): string => `The change was not saved. ${reason}`,
  },
};
