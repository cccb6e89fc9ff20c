import type { RunStatus } from "./model/action-runner";
import type { AnyRequest } from "../../shared/api/action-requests";

const activity: Readonly<Record<string, string>> = {
  run_movement: "movement",
  run_trial: "trial",
  move_joints: "joint motion",
  move_pose: "motion to a pose",
  say: "speech",
  express: "expression",
  take_posture: "posture",
  run_behaviour: "behaviour",
  set_stiffness: "stiffness change",
  look_at: "look at a point",
  drive: "drive",
  go_to: "navigation",
};

export const texts = {
  status: {
    sent: "sent",
    accepted: "accepted",
    started: "started",
    unknown: "outcome unknown",
    done: "done",
    failed: "failed",
    expired: "expired",
    cancelled: "cancelled",
    refused: "rejected",
    unanswered: "no response",
  } satisfies Record<RunStatus, string>,
  output: "Output",
  cancel: "Cancel",
  running: (kind: string, name: string): string => `Running: ${name === "" ? (activity[kind] ?? kind) : name}`,
  undo: "Back to previous pose",
  dismiss: "Dismiss",
  unanswered: "The server's response was lost, so the robot may have received the command. Check the robot before you repeat it.",
  postures: "Postures",
  expressions: "Expressions",
  behaviours: "Behaviours",
  recoveries: "Recovery",
  recoveriesNote: "Look at the robot and remove the cause first. A recovery moves no joints. Reset Stop afterwards.",
  speech: "Speech",
  pose: "Move to pose",
  place: "Go to position",
  look: "Look at point",
  stiffness: "Stiffness",
  speed: "Speed",
  strength: "Intensity",
  textToSpeak: "Text to speak",
  speak: "Speak",
  language: "Language",
  defaultLanguage: "default",
  languages: { en: "English", sk: "Slovak", de: "German", fr: "French", es: "Spanish", id: "Indonesian" },
  axes: ["x", "y", "z"] as const,
  rotations: ["roll", "pitch", "yaw"] as const,
  frame: "Frame",
  useCurrentPose: "Use current pose",
  path: "Path",
  paths: { plan: "Avoid obstacles", direct: "Joint space", straight: "Straight line" },
  move: "Move",
  lookNote: "In the robot's axes: x forward, y left, z up.",
  lookAt: "Look",
  heading: "heading",
  placeNote: "Click a position on the floor plan, or enter it. Without a heading, the robot keeps its arrival heading.",
  planMissing: "No device in this room publishes positions. Add a room device of the kind “perception”.",
  planWaiting: "Waiting for data from the room…",
  go: "Go",
  useCurrentPosition: "Use current position",
  joint: "Joint",
  allJoints: "All joints",
  set: "Set",
  release: "Release",
  fullStiffness: "Full stiffness",
  limpWarning: "A standing robot falls when its joints are released. Let it sit or crouch first, or hold it.",
  allFullStiffness: "All joints have full stiffness.",
  reducedStiffness: (joints: string): string => `Joints with reduced stiffness: ${joints}.`,
  stiffnessUnknown: "The robot has not published its joint stiffness yet.",
};

/** A short description of a request. */
export function describeRequest(request: AnyRequest | { kind: "stream" }): string {
  const metres = (values: readonly number[]): string => values.map((value) => value.toFixed(2)).join(", ");
  switch (request.kind) {
    case "stream":
      return "Steering";
    case "run_movement":
    case "run_trial":
    case "run_behaviour":
    case "express":
    case "take_posture":
      return request.name;
    case "move_joints":
      return "Joint positions";
    case "move_pose":
      return `Pose at ${metres(request.position_m)} m`;
    case "say":
      return `“${request.text.length > 40 ? `${request.text.slice(0, 40)}…` : request.text}”`;
    case "set_stiffness":
      return request.value === 0 ? "Release joints" : `Stiffness ${Math.round(request.value * 100)} %`;
    case "look_at":
      return `Look at ${metres(request.position_m)} m`;
    case "drive":
      return "Drive";
    case "go_to":
      return `Go to ${metres([request.x_m, request.y_m])} m`;
    case "gather":
      return "Collect data";
    case "shoot":
      return "Measure once";
    case "capture":
      return `Capture ${request.name}`;
    case "set_control":
      return `Set ${request.control}`;
  }
}
