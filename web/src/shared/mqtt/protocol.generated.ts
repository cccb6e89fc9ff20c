// Generated from docs/asyncapi.json by `make contract`; do not edit.
// Only types: what arrives is checked in messages.ts before anything else sees it. SI units and radians.

/**
 * `conn`: the agent's link to the broker. Retained, and the will.
 *
 * `session` rises at each connection; an `online=False` with a lower session than one already seen is old news.
 */
export interface Presence {
  online: boolean;
  session: number;
  at_ms: number;
  software?: string;
}

/**
 * `desc`: what the device is and can do. Retained.
 *
 * `limits` names what the agent itself holds, whoever moves the device: `clearance` and `workspace` are missing
 * where nobody knows the robot's shape.
 *
 * `actions` names the kinds of action that it takes; `postures`, `expressions` and `behaviours` what those of
 * these kinds may name. An agent that names no actions is an older one.
 * `mirrors` and `narrowing`: how its joints hang together.
 * `cameras`: what `cam/{name}` shows; `captures`: what raw data can be had; `controls`: what can be set.
 *
 * `diagnostics`: how what it measures is to be judged, where that is said by no robot type, but by its room.
 * `position_m`: where a room device is, in its room's frame; of a robot its room tells (`positions`).
 * `base`: the limits of one that drives or walks; missing where it stays in its place.
 *
 * `scripts`: movement scripts run in the jail, run with less (`trusted`, as the agent's owner wants it), or are
 * refused; `scripts_note` says why, and what to do.
 */
export interface Description {
  /** letters, digits, _ and -, 1 to 64 of them */
  device: string;
  kind: string;
  /** letters, digits, _ and -, 1 to 64 of them */
  robot_type: string;
  label: string;
  joints?: Joint[];
  mimic_joints?: MimicJoint[];
  position_dependent_limits?: PositionDependentLimit[];
  frames?: string[];
  capabilities?: string[];
  actions?: string[];
  postures?: string[];
  expressions?: string[];
  behaviours?: string[];
  streams?: Stream[];
  cameras?: Stream[];
  captures?: string[];
  controls?: Control[];
  watchdog_ms?: number;
  max_loop_age_ms?: number;
  simulated?: boolean;
  limits?: string[];
  interlocks?: InterlockDescription[];
  diagnostics?: Diagnostic[];
  position_m?: [number, number, number] | null;
  base?: BaseLimits | null;
  scripts?: "sandboxed" | "unavailable" | "unconfined";
  scripts_note?: string;
}

/** One joint and the limits that the agent enforces. */
export interface Joint {
  name: string;
  label: string;
  lower_rad: number;
  upper_rad: number;
  max_velocity_rad_s: number;
  max_acceleration_rad_s2: number;
  max_jerk_rad_s3: number;
  max_effort_nm: number;
}

/**
 * One motor moves two joints.
 *
 * Attributes:
 * joint: The one that only follows: at `factor` times the position of
 * of: the joint that counts. Whoever names either moves both.
 */
export interface MimicJoint {
  joint: string;
  mimics: string;
  multiplier?: number;
}

/**
 * The range of one joint depends on where another one is.
 *
 * Attributes:
 * joint: Whose range; `by`: the other.
 * table: Rows of `by`'s position and the range there, lower and upper [rad]; linear in between. It reaches over
 * all of `by`'s range.
 */
export interface PositionDependentLimit {
  joint: string;
  depends_on: string;
  table: [number, number, number][];
}

/** One stream at `tele/{name}`: `joints` carries `JointTelemetry`, all others `Measurements`. */
export interface Stream {
  /** letters, digits, _ and -, 1 to 64 of them */
  name: string;
  rate_hz: number;
}

/** One thing that can be set, within `lower` and `upper` [`unit`]. */
export interface Control {
  /** letters, digits, _ and -, 1 to 64 of them */
  name: string;
  label: string;
  unit?: string;
  lower: number;
  upper: number;
}

/**
 * When the room slows or holds the device: on its condition, and when its sensor was silent for `stale_ms`.
 *
 * `name` says device, stream and condition; `speed` is the share that is left, 0 for `hold`.
 */
export interface InterlockDescription {
  name: string;
  action: "hold" | "slow";
  speed: number;
  stale_ms: number;
}

/**
 * How some measurements of a device are to be judged. Values in the measurement's own unit.
 *
 * Attributes:
 * stream: The stream that carries them.
 * fields: Their names; `*` stands for any text: `temperature_c.*`.
 * label: What is measured, for people; `unit`: of the values.
 * advice: What to do when something is wrong.
 * low: Below this something breaks; `high`: above.
 * warning_low: Below this somebody should look; `warning_high`: above.
 * change: A lasting shift that is worth a word; without it half of the room to the limits.
 * horizon_s: How long before a limit a trend towards it is told [s].
 * questions: What to look for: `level`, `trend`, `change`, `outlier`; none: nothing there is unusual.
 */
export interface Diagnostic {
  /** letters, digits, _ and -, 1 to 64 of them */
  stream?: string;
  fields: string;
  label: string;
  unit?: string;
  advice?: string;
  low?: number | null;
  high?: number | null;
  warning_low?: number | null;
  warning_high?: number | null;
  change?: number | null;
  horizon_s?: number;
  checks?: string[];
}

/** How fast a base may be driven: forward or back, to a side (0: it cannot), turning. */
export interface BaseLimits {
  forward_m_s: number;
  left_m_s: number;
  turn_rad_s: number;
}

/** `desc/twin`: the drawing from which a page builds its live view. Retained. */
export interface Twin {
  /** letters, digits, _ and -, 1 to 64 of them */
  device: string;
  bodies: Body[];
}

/** One body of the tree; `parent` is its index in `Twin.bodies`, -1 for a root. */
export interface Body {
  name: string;
  parent: number;
  position_m: [number, number, number];
  quaternion: [number, number, number, number];
  joint?: TwinJoint | null;
  geometries?: Geometry[];
}

/**
 * The joint by which a body turns or slides: axis and anchor in the body's own frame.
 *
 * One that `follows` others has no motor of its own: its position is the sum of factor times position of those.
 */
export interface TwinJoint {
  name: string;
  kind: "hinge" | "slide";
  axis: [number, number, number];
  anchor_m: [number, number, number];
  reference_rad?: number;
  follows?: Record<string, number>;
}

/**
 * One primitive shape of a body.
 *
 * `size_m` is as MuJoCo gives it: box half extents; sphere radius; capsule and
 * cylinder radius, half length along z; ellipsoid radii; plane half extents.
 */
export interface Geometry {
  shape: "box" | "capsule" | "cylinder" | "ellipsoid" | "plane" | "sphere";
  size_m: [number, number, number];
  position_m: [number, number, number];
  quaternion: [number, number, number, number];
  rgba: [number, number, number, number];
}

/**
 * `state`: the current condition. Retained; on change and every 30 s, at most once a second.
 *
 * `ended_epoch` is the highest epoch that the device will never obey again. It only rises, so even an old message
 * tells the truth: a lease of such an epoch is nobody's any more. `stiffness` names the joints that hold with less
 * than all their strength, and with which share of it.
 */
export interface State {
  /** letters, digits, _ and -, 1 to 64 of them */
  device: string;
  at_ms: number;
  tick_ms: number;
  mode: Mode;
  epoch: number;
  ended_epoch?: number;
  stop?: StopLatch | null;
  lease?: LeaseState | null;
  action?: ActionState | null;
  faults?: Fault[];
  restrictions?: Restriction[];
  stiffness?: Record<string, number>;
}

/** What the device is doing at this moment. */
export type Mode = "action" | "fault" | "holding" | "idle" | "stopped" | "streaming";

/** Who stopped the device, and when. There until somebody who may resets it. */
export interface StopLatch {
  caller: string;
  reason: string;
  at_ms: number;
}

/**
 * The lease that the device obeys now.
 *
 * `reason` says why it was taken from somebody else, and is empty where it was not. `request` is for people:
 * nothing about motion depends on it.
 */
export interface LeaseState {
  holder: string;
  epoch: number;
  expires_in_ms: number;
  reason?: string;
  request?: OpenRequest | null;
}

/** Somebody asks the holder for control, and gets an answer in the time that is left or none. */
export interface OpenRequest {
  /** letters, digits, _ and -, 1 to 64 of them */
  id: string;
  requester: string;
  expires_in_ms: number;
}

/** The action that the device runs now. */
export interface ActionState {
  /** letters, digits, _ and -, 1 to 64 of them */
  id: string;
  kind: string;
  name?: string;
  progress?: number;
}

/** Something wrong that lasts. */
export interface Fault {
  code: string;
  message: string;
  since_ms: number;
}

/** What the room allows at this moment: `speed` is the share that is left, 0: hold. `source` is an interlock. */
export interface Restriction {
  source: string;
  speed: number;
  reason: string;
}

/**
 * `tele/joints`: all joints of one device at one tick, in the order of `Description.joints`.
 *
 * `epoch` is that of the lease in force at the device, 0 when none is: whoever thinks to have control and reads 0
 * has it no longer. `setpoint_sequence` is the newest setpoint the control loop has taken (0: none in this lease),
 * and `setpoint_sent_ms` the operator's own clock in it, so that the page measures its round trip on one clock.
 * `limited` names what changed a setpoint on its way to the motors.
 */
export interface JointTelemetry {
  tick_ms: number;
  at_ms: number;
  sequence: number;
  mode: Mode;
  position_rad: number[];
  velocity_rad_s: number[];
  effort_nm: number[];
  commanded_rad: number[];
  frames?: [number, number, number, number, number, number, number][];
  epoch?: number;
  setpoint_sequence?: number;
  setpoint_sent_ms?: number;
  loop_age_ms?: number;
  limited?: string[];
}

/**
 * `tele/{stream}`, every stream but `joints`: named values, all measured at one moment.
 *
 * A name is a quantity with its unit, then a dot and the part of the device where there are several:
 * `temperature_c.elbow`. `sequence` counts up from one start of the agent to the next.
 */
export interface Measurements {
  tick_ms: number;
  at_ms: number;
  sequence: number;
  values: Record<string, number | boolean>;
}

/** `event`: a fact that happened, in the past tense. Stored. */
export interface Event {
  /** letters, digits, _ and -, 1 to 64 of them */
  id: string;
  /** letters, digits, _ and -, 1 to 64 of them */
  device: string;
  at_ms: number;
  kind: string;
  severity: "error" | "info" | "warning";
  message: string;
  data?: Record<string, unknown>;
}

/** `ack`: the device's answer to one command. `sequence` orders the acks of one command. */
export interface Ack {
  /** letters, digits, _ and -, 1 to 64 of them */
  id: string;
  status: AckStatus;
  sequence: number;
  at_ms: number;
  tick_ms: number;
  reason?: Reason | null;
  progress?: number | null;
  output?: string;
  result?: Record<string, unknown>;
}

/** How far a command has come. The last four are terminal. */
export type AckStatus = "accepted" | "cancelled" | "done" | "expired" | "failed" | "received" | "started";

/** Why a command ended as it did: a code for programs, a sentence for people that says what to do. */
export interface Reason {
  code: string;
  message: string;
}

/**
 * `cmd`: a request to a device; travels inside `signing.Signed`.
 *
 * `space`, `agent` and `device` bind it to one device, `epoch` to one lease; it runs at most once per
 * `id` and never later than `issued_at_ms + ttl_ms` on the cloud's clock, which the agent reads as an offset to
 * its own monotonic clock.
 */
export interface Command {
  /** letters, digits, _ and -, 1 to 64 of them */
  id: string;
  /** letters, digits, _ and -, 1 to 64 of them */
  space: string;
  /** letters, digits, _ and -, 1 to 64 of them */
  agent: string;
  /** letters, digits, _ and -, 1 to 64 of them */
  device: string;
  issued_at_ms: number;
  ttl_ms: number;
  caller: string;
  epoch: number;
  request: GrantLease | ReleaseLease | RequestControl | WithdrawRequest | RunMovement | MoveJoints | MovePose | Say | Express | TakePosture | RunBehaviour | SetStiffness | LookAt | Drive | GoTo | CollectData | TakePicture | CaptureRaw | SetControl | CancelAction | StopDevice | ResetStop | RotateKey;
}

/**
 * Control of the device now belongs to `holder`, for `lease_ms` from the moment of arrival. Also renews.
 *
 * `reason`: why it was taken from somebody else, for that person to read.
 */
export interface GrantLease {
  kind: "grant_lease";
  holder: string;
  lease_ms: number;
  reason?: string;
}

/** Nobody controls the device any more; what moves is brought to a hold. */
export interface ReleaseLease {
  kind: "release_lease";
}

/** Show the holder, and everybody, that somebody asks for control. Changes nothing else; lapses by itself. */
export interface RequestControl {
  kind: "ask_lease";
  /** letters, digits, _ and -, 1 to 64 of them */
  request: string;
  requester: string;
  answer_within_ms: number;
}

/** Nobody asks any more: refused, or withdrawn. */
export interface WithdrawRequest {
  kind: "drop_request";
  /** letters, digits, _ and -, 1 to 64 of them */
  request: string;
}

/**
 * Run one movement script. The source must hash to `sha256` (hex).
 *
 * `signature` is the one that was made, with the cloud's key `key`, when the movement was saved: over robot type,
 * name, version and hash. `author` is the account that saved it, or `SHIPPED`: each author counts versions by
 * itself, and a device never runs an older one than it has. It is ended after `timeout_ms`.
 */
export interface RunMovement {
  kind: "run_movement";
  /** letters, digits, _ and -, 1 to 64 of them */
  robot_type: string;
  /** letters, digits, _ and -, 1 to 64 of them */
  name: string;
  version: number;
  sha256: string;
  source: string;
  parameters?: Record<string, unknown>;
  author?: string;
  key?: string;
  signature?: string;
  timeout_ms?: number;
}

/** Move to joint positions and end there; `plan`: around what is in between. */
export interface MoveJoints {
  kind: "move_joints";
  /** joint name → position [rad]; joints not named keep their target */
  position_rad: Record<string, number>;
  /** share of each joint's velocity limit */
  speed?: number;
  plan?: boolean;
}

/**
 * Bring a frame to a pose in the robot's base frame and end there; no frame: the last of the device's.
 *
 * The orientation is a quaternion (w, x, y, z), or roll, pitch and yaw about the base's axes; with neither the frame
 * keeps its own. `straight`: on a straight line. `plan`: around what is in between.
 */
export interface MovePose {
  kind: "move_pose";
  position_m: [number, number, number];
  quaternion?: [number, number, number, number] | null;
  rpy_rad?: [number, number, number] | null;
  frame?: string;
  /** share of each joint's velocity limit */
  speed?: number;
  straight?: boolean;
  plan?: boolean;
}

/** Speak `text`, and end when it is said; `language` as `en` or `sk`, or empty for the robot's own. */
export interface Say {
  kind: "say";
  text: string;
  language?: string;
}

/** Show one of the device's expressions; `strength` 0 is home. */
export interface Express {
  kind: "express";
  /** letters, digits, _ and -, 1 to 64 of them */
  name: string;
  strength?: number;
}

/** Move to one of the device's postures. */
export interface TakePosture {
  kind: "take_posture";
  /** letters, digits, _ and -, 1 to 64 of them */
  name: string;
  /** share of each joint's velocity limit */
  speed?: number;
}

/** Run one of the device's behaviours to its end. */
export interface RunBehaviour {
  kind: "run_behaviour";
  /** letters, digits, _ and -, 1 to 64 of them */
  name: string;
}

/** Let joints hold with `value` of their strength, 0: limp; no joints: all. It lasts beyond the action. */
export interface SetStiffness {
  kind: "set_stiffness";
  value: number;
  joints?: string[];
}

/** Turn the gaze to a point x, y, z in the robot's base frame [m]. */
export interface LookAt {
  kind: "look_at";
  position_m: [number, number, number];
  /** share of each joint's velocity limit */
  speed?: number;
}

/** Move the base at a velocity for a time, then stand; `turn_rad_s` is counter-clockwise. */
export interface Drive {
  kind: "drive";
  forward_m_s?: number;
  left_m_s?: number;
  turn_rad_s?: number;
  duration_s?: number;
}

/** Go to a place in the room, around what stands there now; `yaw_rad`: how to stand, counter-clockwise from x. */
export interface GoTo {
  kind: "go_to";
  x_m: number;
  y_m: number;
  yaw_rad?: number | null;
}

/** Measure these streams of a room device at this rate for a time, then again as before; no streams: all. */
export interface CollectData {
  kind: "gather";
  streams?: string[];
  rate_hz: number;
  duration_s: number;
}

/** Measure these streams of a room device once, now; no streams: all. The result has the `values`. */
export interface TakePicture {
  kind: "shoot";
  streams?: string[];
}

/** Take a raw picture or scan and store it; the result names the `upload`. */
export interface CaptureRaw {
  kind: "capture";
  /** letters, digits, _ and -, 1 to 64 of them */
  name: string;
}

/** Set a control of a room device, within its limits and in its unit; the result says what was `applied`. */
export interface SetControl {
  kind: "set_control";
  /** letters, digits, _ and -, 1 to 64 of them */
  control: string;
  value: number;
}

/** End the named action; the device holds where it is. */
export interface CancelAction {
  kind: "cancel_action";
  /** letters, digits, _ and -, 1 to 64 of them */
  action: string;
}

/** Latch Stop. */
export interface StopDevice {
  kind: "stop_device";
  reason?: string;
}

/**
 * Release the Stop latch. Nothing resumes.
 *
 * It brings an epoch of its own, which ends with it: what was ordered before the reset is never obeyed after it, and a
 * reset that comes late, or again, is older than the latch that it finds.
 */
export interface ResetStop {
  kind: "reset_stop";
}

/**
 * The cloud has new keys: statements that lead to the newest, oldest first (`device_agent.protocol.security.key_rotation`).
 *
 * Changes nothing else, and takes the device from nobody.
 */
export interface RotateKey {
  kind: "follow_key";
  statements: string[];
}

/**
 * `ctl/{epoch}`: one streamed setpoint. The newest wins; `sequence` starts at 1 in each lease.
 *
 * `echo_tick_ms` is `tick_ms` of the last telemetry the operator saw: its age on the robot's own clock is the
 * loop age. `sent_ms` is any clock of the operator's [ms]; telemetry echoes it.
 */
export interface Setpoint {
  epoch: number;
  sequence: number;
  echo_tick_ms: number;
  sent_ms: number;
  target: JointTarget | JogTarget | DriveTarget;
}

/** Go to these joint positions, as fast as limits allow. */
export interface JointTarget {
  kind: "joints";
  /** joint name → position [rad]; joints not named keep their target */
  position_rad: Record<string, number>;
}

/**
 * Move a frame at this velocity while setpoints are fresh; no frame: the last of the device's.
 *
 * Along and about the axes of the robot's base, or with `tool` those of the frame itself.
 */
export interface JogTarget {
  kind: "jog";
  linear_m_s?: [number, number, number];
  angular_rad_s?: [number, number, number];
  frame?: string;
  tool?: boolean;
}

/** Move the base at this velocity while setpoints are fresh; `turn_rad_s` is counter-clockwise. */
export interface DriveTarget {
  kind: "drive";
  forward_m_s?: number;
  left_m_s?: number;
  turn_rad_s?: number;
}

/** `stop`: latch Stop now. Needs no lease and no signature: the broker lets only those publish it who may. */
export interface Stop {
  /** letters, digits, _ and -, 1 to 64 of them */
  id: string;
  caller: string;
  reason?: string;
}

/** Ed25519 over `telescope/v1/command` + line feed + the exact bytes of `body`. */
export interface Signed {
  /** Id of the signing key. */
  key: string;
  /** base64url, without padding. */
  signature: string;
  body: Command;
}
