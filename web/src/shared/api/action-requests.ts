/** The union of all action requests. A device's description lists those it accepts. */
import type {
  CaptureRaw, CollectData, Drive, Express, GoTo, LookAt, MoveJoints, MovePose, RunBehaviour, Say, SetControl,
  SetStiffness, TakePicture, TakePosture,
} from "../mqtt/protocol.generated";

/** Runs a movement by name; the cloud adds the newest version of its script. */
interface RunMovementByName {
  kind: "run_movement";
  name: string;
  parameters?: Record<string, unknown>;
}

/** Runs one trial of a task; the cloud adds its movement. `seed` null: a random one, if the task resets objects. */
interface RunTrialByName {
  kind: "run_trial";
  name: string;
  seed: number | null;
}

type RobotRequest =
  | RunMovementByName
  | RunTrialByName
  | MoveJoints
  | MovePose
  | Say
  | Express
  | TakePosture
  | RunBehaviour
  | SetStiffness
  | LookAt
  | Drive
  | GoTo;

/** Actions of room devices. */
export type RoomRequest = CollectData | TakePicture | CaptureRaw | SetControl;

export type AnyRequest = RobotRequest | RoomRequest;

/** Actions without motion: the device's state confirms them. */
const WITHOUT_MOTION: ReadonlySet<AnyRequest["kind"]> = new Set(["say", "set_stiffness", "gather", "shoot", "capture", "set_control"]);

export function moves({ kind }: { kind: AnyRequest["kind"] | "stream" }): boolean {
  return kind === "stream" || !WITHOUT_MOTION.has(kind);
}
