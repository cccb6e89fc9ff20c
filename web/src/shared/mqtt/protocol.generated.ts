// Generated from docs/asyncapi.json by `make contract`; do not edit.
// The types that the console uses. parse-messages.ts validates received messages. SI units and radians.

/**
 * `conn`: whether the agent is connected to the broker. Retained, and the MQTT will.
 *
 * `session` rises with each connection. Readers ignore `online=False` with a lower session than the newest one.
 *
 * Attributes:
 * protocol: Versions of the wire contract that the agent supports.
 * capabilities: Kinds of request that the agent accepts; empty: not reported.
 */
export interface Presence {
  online: boolean;
  session: number;
  at_ms: number;
  /** no control and format characters */
  software?: string;
  protocol?: VersionRange;
  /** kinds of request */
  capabilities?: string[];
}

/** All versions from `min` to `max`. Programs that report no range support version 1. */
export interface VersionRange {
  min?: number;
  max?: number;
}

/**
 * `desc`: what the device is and can do. Retained.
 *
 * Attributes:
 * mimic_joints: Joints that follow other joints.
 * position_dependent_limits: Joint ranges that depend on other joints.
 * actions: Kinds of actions that the device accepts. `postures`, `expressions` and `behaviours` list the
 * names that such actions may use. Empty for older agents.
 * robot_behaviours: Those of the `behaviours` that the robot itself provides.
 * cameras: Streams of frames at `cam/{name}`, each of one kind.
 * captures: Raw data that can be captured.
 * controls: Values that can be set.
 * limits: Limits that the agent enforces for every command source. `clearance` and `workspace` are absent if
 * the shape of the robot is unknown.
 * diagnostics: How the cloud evaluates the measurements of a room device; for robots, see the robot type.
 * position_m: Position of a room device in the room; the stream `positions` of the room reports robots.
 * base: Limits of a mobile base; `None` for a fixed robot.
 * streaming: Whether setpoints reach the device. `False`: the agent polls over HTTP; use actions instead.
 * scripts: `sandboxed`: movement scripts run confined. `unconfined`: they run with fewer layers, as the
 * agent's owner allows. `unavailable`: they are rejected.
 * scripts_note: Why scripts are not sandboxed, and the remedy.
 */
export interface Description {
  /** letters, digits, _ and -, 1 to 64 of them */
  device: string;
  /** no control and format characters */
  kind: string;
  /** letters, digits, _ and -, 1 to 64 of them */
  robot_type: string;
  /** no control and format characters */
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
  robot_behaviours?: RobotBehaviour[];
  streams?: Stream[];
  cameras?: CameraStream[];
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
  streaming?: boolean;
  scripts?: "sandboxed" | "unavailable" | "unconfined";
  scripts_note?: string;
}

/** One joint and the limits that the agent enforces. */
export interface Joint {
  /** no control and format characters */
  name: string;
  /** no control and format characters */
  label: string;
  lower_rad: number;
  upper_rad: number;
  max_velocity_rad_s: number;
  max_acceleration_rad_s2: number;
  max_jerk_rad_s3: number;
  max_effort_nm: number;
}

/**
 * A joint that follows another joint, because one motor moves both. A command for either joint moves both.
 *
 * Attributes:
 * joint: The joint that follows.
 * mimics: The joint that it follows.
 * multiplier: Position of `joint` divided by the position of `mimics`.
 */
export interface MimicJoint {
  /** no control and format characters */
  joint: string;
  /** no control and format characters */
  mimics: string;
  multiplier?: number;
}

/**
 * The range of one joint depends on the position of another joint.
 *
 * Attributes:
 * joint: The joint with the variable range.
 * depends_on: The joint that determines the range.
 * table: Rows of the position of `depends_on` and the lower and upper limit there [rad], interpolated linearly.
 * The rows cover the whole range of `depends_on`.
 */
export interface PositionDependentLimit {
  /** no control and format characters */
  joint: string;
  /** no control and format characters */
  depends_on: string;
  table: [number, number, number][];
}

/**
 * A behaviour that the robot itself provides. It moves its joints without the agent's limits.
 *
 * Attributes:
 * name: Name for `run_behaviour`; also listed in `behaviours`.
 * label: The robot's own name of it.
 * recovery: Whether it removes a fault. It moves no joints, and may be started while Stop is latched.
 */
export interface RobotBehaviour {
  /** letters, digits, _ and -, 1 to 64 of them */
  name: string;
  /** no control and format characters */
  label: string;
  recovery?: boolean;
}

/** A stream at `tele/{name}`: `joints` carries `JointTelemetry`, all others `Measurements`. */
export interface Stream {
  /** letters, digits, _ and -, 1 to 64 of them */
  name: string;
  rate_hz: number;
}

/**
 * A stream of frames at `cam/{name}`.
 *
 * Attributes:
 * kind: Content of the frames, one of `camera_frames.KINDS`: `colour`, `depth`, `scan` or `people`.
 * Receivers ignore streams of unknown kinds.
 */
export interface CameraStream {
  /** letters, digits, _ and -, 1 to 64 of them */
  name: string;
  rate_hz: number;
  /** no control and format characters */
  kind?: string;
}

/** A value that can be set, between `lower` and `upper` [`unit`]. */
export interface Control {
  /** letters, digits, _ and -, 1 to 64 of them */
  name: string;
  /** no control and format characters */
  label: string;
  unit?: string;
  lower: number;
  upper: number;
}

/**
 * An interlock: the room slows or holds the device on a condition, or if its sensor is silent for `stale_ms`.
 *
 * Attributes:
 * name: Device, stream and condition.
 * speed: Remaining share of the speed limits; 0 for `hold`.
 */
export interface InterlockDescription {
  name: string;
  action: "hold" | "slow";
  speed: number;
  stale_ms: number;
}

/**
 * How the cloud evaluates measurements of a device. Limits are in the measurement's own unit.
 *
 * Attributes:
 * stream: Stream of the measurements.
 * fields: Names of the measurements; `*` matches any text: `temperature_c.*`.
 * label: Display name of the quantity.
 * unit: Unit of the values.
 * advice: What to do when a check fails.
 * low: Values below are an error.
 * high: Values above are an error.
 * warning_low: Values below are a warning.
 * warning_high: Values above are a warning.
 * change: Lasting shift that is reported; `None`: half of the distance to the limits.
 * horizon_s: A trend is reported this long before it reaches a limit [s].
 * checks: Checks to run: `level`, `trend`, `change`, `outlier`; empty: no value is unusual.
 */
export interface Diagnostic {
  /** letters, digits, _ and -, 1 to 64 of them */
  stream?: string;
  fields: string;
  /** no control and format characters */
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

/** Speed limits of a mobile base: forwards and backwards, sideways (0: not possible) and turning. */
export interface BaseLimits {
  forward_m_s: number;
  left_m_s: number;
  turn_rad_s: number;
}

/** `desc/twin`: the model from which the console draws the live view. Retained. */
export interface Twin {
  /** letters, digits, _ and -, 1 to 64 of them */
  device: string;
  bodies: Body[];
}

/** One body of the tree. `parent` is its index in `Twin.bodies`, -1 for a root. */
export interface Body {
  /** no control and format characters */
  name: string;
  parent: number;
  position_m: [number, number, number];
  quaternion: [number, number, number, number];
  joint?: TwinJoint | null;
  geometries?: Geometry[];
}

/**
 * The joint that moves a body relative to its parent. Axis and anchor are in the body's own frame.
 *
 * A joint that `follows` others has no motor: its position is the sum of multiplier times position of those joints.
 */
export interface TwinJoint {
  /** no control and format characters */
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
 * `size_m` follows MuJoCo: half extents of a box; radius of a sphere; radius and half length along z of a capsule
 * or cylinder; radii of an ellipsoid; half extents of a plane.
 */
export interface Geometry {
  shape: "box" | "capsule" | "cylinder" | "ellipsoid" | "plane" | "sphere";
  size_m: [number, number, number];
  position_m: [number, number, number];
  quaternion: [number, number, number, number];
  rgba: [number, number, number, number];
}

/**
 * `state`: the current condition. Retained; published on change and every 30 s.
 *
 * It is published at most once per second, and at once for a new fault.
 *
 * Attributes:
 * ended_epoch: Highest epoch that the device no longer accepts. It only rises, so even an outdated message
 * correctly marks the leases that have ended.
 * stiffness: Joints that hold with reduced strength: joint name → share of the full strength.
 * load: Which work the agent reduces because its machine is overloaded: 0: none; 1: cameras; 2: also perception;
 * 3: also telemetry. Control is never reduced.
 * recording: Whether the session is being recorded on the agent's disk.
 * recorded_cameras: Cameras that are being recorded now, in a session of this robot or, for a room device, of any
 * robot of its agent: names of own cameras, and `{device}/{camera}` of room devices.
 * camera_consent: The owner's consent to record cameras; `None`: the device has no camera that can be recorded.
 * rates_hz: Measured rate of each stream and camera: `tele/joints`, `cam/front` → messages a second [Hz]. The
 * configured rates are in `desc`.
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
  load?: number;
  rates_hz?: Record<string, number>;
  recording?: boolean;
  recorded_cameras?: string[];
  camera_consent?: CameraConsent | null;
}

/** What the device is doing now. */
export type Mode = "action" | "fault" | "holding" | "idle" | "stopped" | "streaming";

/**
 * Who stopped the device, and when. It stays until an authorized caller resets it.
 *
 * `verified`: a signed command names the caller. Otherwise only the broker vouches for the account.
 */
export interface StopLatch {
  /** no control and format characters */
  caller: string;
  reason: string;
  at_ms: number;
  verified?: boolean;
}

/**
 * The lease in force at the device.
 *
 * Attributes:
 * holder: Name of the operator in control.
 * epoch: Fencing token of the lease.
 * expires_in_ms: Remaining time [ms].
 * reason: Why control was taken from another operator; empty otherwise.
 * request: Pending request for control. For display only: motion does not depend on it.
 */
export interface LeaseState {
  /** no control and format characters */
  holder: string;
  epoch: number;
  expires_in_ms: number;
  reason?: string;
  request?: OpenRequest | null;
}

/** A pending request for control. It expires without a response after `expires_in_ms`. */
export interface OpenRequest {
  /** letters, digits, _ and -, 1 to 64 of them */
  id: string;
  /** no control and format characters */
  requester: string;
  expires_in_ms: number;
}

/** The action that the device runs now. */
export interface ActionState {
  /** letters, digits, _ and -, 1 to 64 of them */
  id: string;
  /** no control and format characters */
  kind: string;
  /** no control and format characters */
  name?: string;
  progress?: number;
}

/**
 * A fault, until its condition has been absent for half a minute.
 *
 * `count`: how often the condition has occurred since `since_ms`; `last_ms`: when it was last present.
 */
export interface Fault {
  /** no control and format characters */
  code: string;
  message: string;
  since_ms: number;
  count?: number;
  last_ms?: number;
}

/** A speed restriction of the room, set by the interlock `source`. `speed` is the remaining share; 0: hold. */
export interface Restriction {
  source: string;
  speed: number;
  reason: string;
}

/**
 * The owner's decision which cameras of the device may be recorded, as the agent has stored it.
 *
 * Attributes:
 * cameras: Names of the cameras that may be recorded; empty: none.
 * by: Name of the account that decided; empty: there was no decision yet.
 * at_ms: When the agent stored the decision.
 * number: Number of the decision.
 */
export interface CameraConsent {
  cameras?: string[];
  /** no control and format characters */
  by?: string;
  at_ms?: number;
  number?: number;
}

/**
 * `tele/joints`: all joints of one device at one tick, in the order of `Description.joints`.
 *
 * Attributes:
 * epoch: Epoch of the lease in force at the device, 0 for none. A holder that reads 0 has lost control.
 * setpoint_sequence: Newest setpoint that the control loop has accepted; 0 for none in this lease.
 * setpoint_sent_ms: `sent_ms` of that setpoint, so that the operator measures its round trip on one clock.
 * ended_input: Highest `input` of this lease whose setpoints the device no longer accepts; 0 for none.
 * limited: Limits that changed a setpoint before it reached the motors.
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
  ended_input?: number;
  limited?: string[];
}

/**
 * `tele/{stream}` except `joints`: named values, all measured at one moment.
 *
 * A name consists of a quantity with its unit and, if the device has several, a dot and the part:
 * `temperature_c.elbow`. `sequence` starts anew with each start of the agent.
 */
export interface Measurements {
  tick_ms: number;
  at_ms: number;
  sequence: number;
  values: Record<string, number | boolean>;
}

/**
 * A frame of the kind `people`: all people that the sensor tracks now.
 *
 * Attributes:
 * position_m: Position of the camera in the room [m].
 * rotation: Its axes in the room: x to the right, y up, viewing direction -z.
 * fovy_rad: Its vertical field of view [rad]; pixels are square.
 * people: The tracked people.
 */
export interface TrackedPeople {
  position_m: [number, number, number];
  /** rows of the matrix whose columns are the axes in the room */
  rotation: [[number, number, number], [number, number, number], [number, number, number]];
  fovy_rad: number;
  people?: TrackedPerson[];
}

/**
 * One tracked person.
 *
 * Attributes:
 * id: Number that stays the same while the person is tracked.
 * position_m: Centre of the body in the room [m].
 * joints: Known joints; a joint without an estimate is missing.
 */
export interface TrackedPerson {
  id: number;
  position_m: [number, number, number];
  joints?: BodyJoint[];
}

/**
 * One joint of a tracked person.
 *
 * Attributes:
 * name: One of the 20 joints of Kinect v1, for example `hand_left`; left and right are those of the person.
 * position_m: Position in the room [m].
 * state: `tracked`: the sensor sees the joint. `inferred`: it does not; the position is an estimate.
 */
export interface BodyJoint {
  /** no control and format characters */
  name: string;
  position_m: [number, number, number];
  state: "inferred" | "tracked";
}

/** `event`: a fact that happened, in the past tense. The cloud stores it. */
export interface Event {
  /** letters, digits, _ and -, 1 to 64 of them */
  id: string;
  /** letters, digits, _ and -, 1 to 64 of them */
  device: string;
  at_ms: number;
  /** no control and format characters */
  kind: string;
  severity: "error" | "info" | "warning";
  message: string;
  data?: Record<string, unknown>;
}

/**
 * `ack`: the device's response to one command. `sequence` orders the acknowledgements of one command.
 *
 * `traceparent`: the device's span, if the command is traced.
 */
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
  /** the header `traceparent` of W3C Trace Context; receivers ignore an invalid one */
  traceparent?: string;
}

/** Progress of a command. The last four values are terminal. */
export type AckStatus = "accepted" | "cancelled" | "done" | "expired" | "failed" | "received" | "started";

/**
 * Why a command ended: a code for programs, and a message for people that names the remedy.
 *
 * `epoch`: highest epoch that the device has seen, if it rejected the command because of its epoch; otherwise 0.
 */
export interface Reason {
  /** no control and format characters */
  code: string;
  message: string;
  epoch?: number;
}

/** Move to joint positions. `plan`: avoid obstacles. */
export interface MoveJoints {
  kind: "move_joints";
  /** joint name → position [rad]; other joints keep their target */
  position_rad: Record<string, number>;
  /** share of each joint's velocity limit */
  speed?: number;
  plan?: boolean;
}

/**
 * Move a frame to a pose in the robot's base frame.
 *
 * Attributes:
 * quaternion: Target orientation (w, x, y, z).
 * rpy_rad: Target roll, pitch and yaw about the axes of the base; without either orientation, it is kept.
 * frame: Frame to move; empty for the device's last frame.
 * straight: Move on a straight line.
 * plan: Avoid obstacles.
 */
export interface MovePose {
  kind: "move_pose";
  position_m: [number, number, number];
  quaternion?: [number, number, number, number] | null;
  rpy_rad?: [number, number, number] | null;
  /** no control and format characters */
  frame?: string;
  /** share of each joint's velocity limit */
  speed?: number;
  straight?: boolean;
  plan?: boolean;
}

/** Speak `text`; ends when speech ends. `language`: `en`, `sk` …; empty for the robot's default. */
export interface Say {
  kind: "say";
  text: string;
  language?: string;
}

/** Show an expression of the device; `strength` 0 is the home position. */
export interface Express {
  kind: "express";
  /** letters, digits, _ and -, 1 to 64 of them */
  name: string;
  strength?: number;
}

/** Move to a posture of the device. */
export interface TakePosture {
  kind: "take_posture";
  /** letters, digits, _ and -, 1 to 64 of them */
  name: string;
  /** share of each joint's velocity limit */
  speed?: number;
}

/** Run a behaviour of the device to its end. */
export interface RunBehaviour {
  kind: "run_behaviour";
  /** letters, digits, _ and -, 1 to 64 of them */
  name: string;
}

/** Set the holding strength of joints to the share `value`; 0: limp. No joints: all. Outlasts the action. */
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

/** Drive the base at a velocity for a time, then stop; `turn_rad_s` is counter-clockwise. */
export interface Drive {
  kind: "drive";
  forward_m_s?: number;
  left_m_s?: number;
  turn_rad_s?: number;
  duration_s?: number;
}

/** Navigate to a position in the room around obstacles; `yaw_rad`: final heading, counter-clockwise from x. */
export interface GoTo {
  kind: "go_to";
  x_m: number;
  y_m: number;
  yaw_rad?: number | null;
}

/** Measure streams of a room device at another rate for a time; no streams: all. */
export interface CollectData {
  kind: "gather";
  streams?: string[];
  rate_hz: number;
  duration_s: number;
}

/** Measure streams of a room device once, now; no streams: all. The result contains the `values`. */
export interface TakePicture {
  kind: "shoot";
  streams?: string[];
}

/** Capture raw data and upload it; the result names the `upload`. */
export interface CaptureRaw {
  kind: "capture";
  /** letters, digits, _ and -, 1 to 64 of them */
  name: string;
}

/** Set a control of a room device, within its limits and in its unit. The result contains the `applied` value. */
export interface SetControl {
  kind: "set_control";
  /** letters, digits, _ and -, 1 to 64 of them */
  control: string;
  value: number;
}

/**
 * One streamed setpoint; the body of `setpoints.Tagged`. The newest is used; `sequence` rises in each lease.
 *
 * Attributes:
 * echo_tick_ms: `tick_ms` of the newest telemetry that the operator has received. Its age on the robot's own
 * clock is the loop age.
 * sent_ms: Time of sending on any clock of the operator [ms]; telemetry echoes it.
 * input: Number of the operator's input in this lease, from 1: each press of a pointer, key or gamepad starts a
 * new one. After a watchdog hold the device accepts only a higher number. 0: not numbered; a watchdog hold
 * then ends the lease.
 */
export interface Setpoint {
  epoch: number;
  sequence: number;
  echo_tick_ms: number;
  sent_ms: number;
  target: JointTarget | JogTarget | DriveTarget;
  input?: number;
}

/** Move to joint positions as fast as the limits allow. */
export interface JointTarget {
  kind: "joints";
  /** joint name → position [rad]; other joints keep their target */
  position_rad: Record<string, number>;
}

/**
 * Move a frame at a velocity while setpoints are fresh; no frame: the device's last frame.
 *
 * Velocities are along and about the axes of the robot's base, or with `tool` those of the frame itself.
 */
export interface JogTarget {
  kind: "jog";
  linear_m_s?: [number, number, number];
  angular_rad_s?: [number, number, number];
  /** no control and format characters */
  frame?: string;
  tool?: boolean;
}

/** Drive the base at a velocity while setpoints are fresh; `turn_rad_s` is counter-clockwise. */
export interface DriveTarget {
  kind: "drive";
  forward_m_s?: number;
  left_m_s?: number;
  turn_rad_s?: number;
}

/**
 * `stop/{author}`: latch Stop now. Needs no lease and no signature, and unknown fields do not prevent it.
 *
 * The last topic level is the author's account; the broker allows each account only its own. The device shows this
 * author as unverified until the signed `stop_device` command arrives.
 */
export interface Stop {
  /** letters, digits, _ and -, 1 to 64 of them */
  id: string;
  reason?: string;
}

/** HMAC-SHA256 with the lease's `setpoint_key` over `telescope/v1/setpoint` + line feed + the topic + line feed + the exact bytes of `body`; the first 16 bytes. */
export interface Tagged {
  /** The tag in hexadecimal. */
  tag: string;
  body: Setpoint;
}
