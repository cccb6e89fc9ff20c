// Types of the wire contract, as device_agent/protocol/messages.py has them. Only types: what arrives is checked
// against them in messages.ts before anything else sees it. SI units and radians; the unit is in the field's name.

export type Vector3 = [number, number, number];
/** w, x, y, z (a colour: red, green, blue, alpha) */
export type Quaternion = [number, number, number, number];
/** position x, y, z [m] and quaternion w, x, y, z of a frame in the robot's base */
export type Pose = [number, number, number, number, number, number, number];

export interface Presence {
  online: boolean;
  session: number;
  at_ms: number;
  software?: string;
}

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

export interface Stream {
  name: string;
  rate_hz: number;
}

export interface Description {
  device: string;
  kind: string;
  robot_type: string;
  label: string;
  joints?: Joint[];
  frames?: string[];
  capabilities?: string[];
  streams?: Stream[];
  watchdog_ms?: number;
  max_loop_age_ms?: number;
  simulated?: boolean;
}

export interface Geometry {
  shape: "box" | "sphere" | "capsule" | "cylinder" | "ellipsoid" | "plane";
  size_m: Vector3;
  position_m: Vector3;
  quaternion: Quaternion;
  rgba: Quaternion;
}

export interface TwinJoint {
  name: string;
  kind: "hinge" | "slide";
  axis: Vector3;
  anchor_m: Vector3;
  reference_rad?: number;
}

export interface Body {
  name: string;
  parent: number;
  position_m: Vector3;
  quaternion: Quaternion;
  joint?: TwinJoint | null;
  geometries?: Geometry[];
}

export interface Twin {
  device: string;
  bodies: Body[];
}

export type Mode = "idle" | "streaming" | "action" | "holding" | "stopped" | "fault";

export interface StopLatch {
  by: string;
  reason: string;
  at_ms: number;
}

export interface LeaseState {
  holder: string;
  epoch: number;
  expires_in_ms: number;
}

export interface ActionState {
  id: string;
  kind: string;
  name?: string;
  progress?: number;
}

export interface Fault {
  code: string;
  message: string;
  since_ms: number;
}

export interface State {
  device: string;
  at_ms: number;
  tick_ms: number;
  mode: Mode;
  epoch: number;
  stop?: StopLatch | null;
  lease?: LeaseState | null;
  action?: ActionState | null;
  faults?: Fault[];
}

export interface JointTelemetry {
  tick_ms: number;
  at_ms: number;
  sequence: number;
  mode: Mode;
  position_rad: number[];
  velocity_rad_s: number[];
  effort_nm: number[];
  commanded_rad: number[];
  frames?: Pose[];
  epoch?: number;
  setpoint_sequence?: number;
  setpoint_sent_ms?: number;
  loop_age_ms?: number;
  limited?: string[];
}

export interface Event {
  id: string;
  device: string;
  at_ms: number;
  kind: string;
  severity: "info" | "warning" | "error";
  message: string;
  data?: { [key: string]: unknown };
}

export type AckStatus = "received" | "accepted" | "started" | "done" | "failed" | "expired" | "cancelled";

export interface Reason {
  code: string;
  message: string;
}

export interface Ack {
  id: string;
  status: AckStatus;
  sequence: number;
  at_ms: number;
  tick_ms: number;
  reason?: Reason | null;
  progress?: number | null;
  output?: string;
  result?: { [key: string]: unknown };
}

export interface JointTarget {
  kind: "joints";
  position_rad: { [joint: string]: number };
}

export interface Setpoint {
  epoch: number;
  sequence: number;
  echo_tick_ms: number;
  sent_ms: number;
  target: JointTarget;
}

export interface Stop {
  id: string;
  by: string;
  reason?: string;
}
