import type { Problem } from "./model/problems";
import type { ActionKind } from "./model/keyframes";
import { format } from "../../shared/i18n/format";

export const texts = {
  title: "Keyframes",
  library: "Movements",
  noRobot: "The model of the robot type. No robot moves.",
  runsOnDevice: "No robot is selected. Save the movement, then run it from its own page or from a robot's page.",
  open: "New movement from keyframes",
  edit: (name: string): string => `Open the keyframes of ${name}`,
  waiting: "Waiting for the robot's description and joint positions…",
  twin: "Movement",
  twinLabel: "3D view of the movement, on a model of the robot",
  viewReset: "Reset view",
  viewWaiting: "Waiting for the robot's model…",
  previewing: "Preview: the robot does not move",
  numberOf: (index: number, count: number): string => `Keyframe ${index} of ${count}`,
  ghost: "Current pose of the robot",
  noGhost: "The robot's current pose is unknown",
  timeline: "Timeline",
  play: "▶ Preview",
  pause: "❚❚ Pause",
  previewOnly: "Moves only the model.",
  seconds: (value: number): string => `${value.toFixed(2)} s`,
  ofSeconds: (value: number, last: number): string => `${value.toFixed(2)} s of ${last.toFixed(2)} s`,
  tick: (value: number): string => `${value} s`,
  playhead: "Preview position",
  marker: (index: number, wrong: boolean): string => `Keyframe ${index}${wrong ? ", has problems" : ""}`,
  add: "Add",
  addMeasured: "Add current pose",
  duplicate: "Duplicate",
  remove: "Delete",
  notLive: "The robot's current pose is unknown.",
  timelineKeys: "Drag a keyframe, or move it with the arrow keys: 0.1 s, with Shift 1 s, with Alt 0.01 s. Ctrl+Z undoes.",
  undo: "Undo",
  redo: "Redo",
  checks: "Checks",
  checked: (count: number): string => (count === 0 ? "" : format.count(count, "problem")),
  noProblems: "✓ Within all joint limits",
  at: (index: number): string => `Keyframe ${index}`,
  robotChecks: "The robot checks for collisions before and during the motion.",
  fixAll: "Stretch all to the required time",
  more: (count: number): string => `And ${count} more.`,
  problem: ({ what }: Problem, joint: string): string => {
    switch (what.kind) {
      case "range":
        return `${joint} is limited to ${format.radiansAsDegrees(what.lower_rad)} to ${format.radiansAsDegrees(what.upper_rad)}.`;
      case "narrowed":
        return `${joint} is limited to ${format.radiansAsDegrees(what.lower_rad)} to ${format.radiansAsDegrees(what.upper_rad)} at this position of ${what.by}.`;
      case "mirrored":
        return `${joint} and ${what.of} share one actuator and must have the same position.`;
      case "unknown-joint":
        return `This robot has no joint ${joint}.`;
      case "unknown-name":
        return `This robot has no “${what.name}”.`;
      case "unsupported":
        return `This robot does not support: ${texts.actions[what.action].toLowerCase()}.`;
      case "control-range":
        return `${what.label} can be set from ${what.lower} to ${what.upper} ${what.unit}`.trim() + ".";
      case "too-fast":
        return `${joint} would exceed its ${what.by} limit before this keyframe.`;
      case "times":
        return "Times must increase from keyframe to keyframe.";
      case "late-joint":
        return `${joint} is set here for the first time; its start position is not defined.`;
      case "too-long-text":
        return "The text is too long: at most 500 characters.";
    }
  },
  fix: ({ what }: Problem): string => {
    switch (what.kind) {
      case "too-fast":
        return `Stretch to ${what.needs_s.toFixed(2)} s`;
      case "range":
      case "narrowed":
      case "control-range":
        return "Move into range";
      case "times":
        return "Sort";
      case "late-joint":
        return "Add to first keyframe";
      case "mirrored":
      case "unknown-joint":
      case "unknown-name":
      case "unsupported":
      case "too-long-text":
        return "Remove";
    }
  },
  number: (index: number): string => `Keyframe ${index}`,
  first: "Start, at 0 s. The robot moves to this pose first, at half speed.",
  time: "Time [s]",
  interval: "Time since previous keyframe [s]",
  shifting: "moves later keyframes",
  useCurrentPose: "Use current pose",
  joints: "Joints of this keyframe",
  positionSet: "set",
  interpolated: "interpolated",
  positionSetFor: (joint: string): string => `${joint} is set at this keyframe`,
  actionsTitle: "Actions at this keyframe",
  actionsNote: "Actions run one after the other; the keyframe time pauses meanwhile.",
  none: "–",
  actionMark: "✦",
  actions: {
    posture: "Posture",
    behaviour: "Behaviour",
    express: "Expression",
    say: "Speak",
    drive: "Drive",
    go_to: "Go to a position in the room",
    set_control: "Gripper or another setting",
  } satisfies Record<ActionKind, string>,
  forward: "forward [m/s]",
  turn: "turn [°/s]",
  duration: "duration [s]",
  x: "x [m]",
  y: "y [m]",
  yaw: "yaw [°]",
  control: "setting",
  controlNames: "The name of the setting: letters, digits, - and _.",
  controlValue: (unit: string): string => (unit === "" ? "value" : `value [${unit}]`),
  script: "Save and run",
  name: "Name",
  description: "Description",
  nameNote: "Letters, digits, - and _.",
  save: "Save",
  saving: "Saving…",
  saveAndRun: "Save and run",
  run: "Run on the robot",
  speed: "Speed",
  fixFirst: "Correct all problems before you run it.",
  tooLong: "The movement exceeds the maximum script size: remove keyframes or joints.",
  savedAs: (version: number): string => `Saved as version ${version}.`,
  newerVersion: (version: number): string => `Version ${version} was saved in the meantime. Your changes are not lost.`,
  deleted: "This movement was deleted in the meantime. Your changes are not lost.",
  overwrite: "Overwrite with mine",
  showScript: "Generated script",
  record: "Record",
  recordNote: "Records the joints while the robot moves, for example steered from another tab or by a movement. Base motion is not recorded.",
  startRecording: "● Record",
  stopRecording: "■ Stop recording",
  recordingGap: "No data from the robot. The recording continues when data arrives.",
  recorded: (samples: number, duration_s: number, gaps: number): string =>
    `${samples} samples in ${duration_s.toFixed(1)} s${gaps === 0 ? "" : `, with ${format.count(gaps, "gap")}`}`,
  gapNote: "The yellow range has no data; the movement is interpolated linearly there.",
  curves: (count: number): string => `${count} moved joints over time`,
  trimFrom: "Start",
  trimTo: "End",
  tolerance: "Tolerance",
  useKeyframes: (count: number): string => `Use these ${count} keyframes`,
  discard: "Discard recording",
  restored: "Unsaved draft restored.",
  revert: "Revert to saved",
  startOver: "Start over",
  draftNotStored: "This browser does not store drafts. Save before you leave.",
  manualScript: (name: string): string => `The script “${name}” contains more than keyframes, so it cannot be edited here.`,
  toCode: "Open in the code editor",
};
