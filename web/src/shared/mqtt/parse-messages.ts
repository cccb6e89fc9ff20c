/**
 * Parses broker messages: JSON of the contract's types, finite numbers and lists of the required length. Unknown fields
 * are accepted, so that the page can read messages of newer agents. The page draws validated data only.
 */
import {
  MAX_JOINTS, MessageError, record, byName, count, fail, flag, list, nullable, number, numbers, object, oneOf,
  optional, pathOf, text, type Check,
} from "./checks";
import type { Pose, Quaternion, Vector3 } from "../lib/vectors";
import type {
  Ack, AckStatus, ActionState, BaseLimits, Body, CameraConsent, CameraStream, Control, Description, Diagnostic, Event, Fault, Geometry,
  InterlockDescription, Joint, JointTelemetry, LeaseState, Measurements, MimicJoint, Mode, PositionDependentLimit,
  OpenRequest, Presence, Reason, Restriction, RobotBehaviour, State, StopLatch, Stream, TwinJoint, VersionRange,
} from "./protocol.generated";

/** Largest message of the contract [bytes]. */
const MAX_BYTES = 128 * 1024;
const MAX_BODIES = 512;

const vector3 = numbers<Vector3>(3);

const quaternion = numbers<Quaternion>(4);

const pose = numbers<Pose>(7);

const mode = oneOf<Mode>("idle", "streaming", "action", "holding", "stopped", "fault");

const presence = object<Required<Presence>>({
  online: flag,
  session: count,
  at_ms: count,
  software: optional(text, ""),
  protocol: optional(object<Required<VersionRange>>({ min: optional(count, 1), max: optional(count, 1) }), { min: 1, max: 1 }),
  capabilities: optional(list(text, MAX_JOINTS), []),
});

const joint = object<Joint>({
  name: text,
  label: text,
  lower_rad: number,
  upper_rad: number,
  max_velocity_rad_s: number,
  max_acceleration_rad_s2: number,
  max_jerk_rad_s3: number,
  max_effort_nm: number,
});

const mimicJoint = object<Required<MimicJoint>>({ joint: text, mimics: text, multiplier: optional(number, 1) });

const positionDependentLimit = object<PositionDependentLimit>({ joint: text, depends_on: text, table: list(vector3, 200) });

const stream = object<Stream>({ name: text, rate_hz: number });

const camera = object<Required<CameraStream>>({ name: text, rate_hz: number, kind: optional(text, "colour") });

const control = object<Required<Control>>({
  name: text,
  label: text,
  unit: optional(text, ""),
  lower: number,
  upper: number,
});

const robotBehaviour = object<Required<RobotBehaviour>>({ name: text, label: text, recovery: optional(flag, false) });

const diagnostic = object<Required<Diagnostic>>({
  stream: optional(text, ""),
  fields: text,
  label: text,
  unit: optional(text, ""),
  advice: optional(text, ""),
  low: nullable(number),
  high: nullable(number),
  warning_low: nullable(number),
  warning_high: nullable(number),
  change: nullable(number),
  horizon_s: optional(number, 0),
  checks: optional(list(text, MAX_JOINTS), []),
});

const description = object<KnownDescription>({
  device: text,
  kind: text,
  robot_type: text,
  label: text,
  joints: optional(list(joint, MAX_JOINTS), []),
  mimic_joints: optional(list(mimicJoint, MAX_JOINTS), []),
  position_dependent_limits: optional(list(positionDependentLimit, MAX_JOINTS), []),
  frames: optional(list(text, MAX_JOINTS), []),
  capabilities: optional(list(text, MAX_JOINTS), []),
  actions: optional(list(text, MAX_JOINTS), []),
  postures: optional(list(text, MAX_JOINTS), []),
  expressions: optional(list(text, MAX_JOINTS), []),
  behaviours: optional(list(text, MAX_JOINTS), []),
  robot_behaviours: optional(list(robotBehaviour, MAX_JOINTS), []),
  streams: optional(list(stream, MAX_JOINTS), []),
  cameras: optional(list(camera, MAX_JOINTS), []),
  captures: optional(list(text, MAX_JOINTS), []),
  controls: optional(list(control, MAX_JOINTS), []),
  watchdog_ms: optional(count, 0),
  max_loop_age_ms: optional(count, 0),
  simulated: optional(flag, false),
  limits: optional(list(text, MAX_JOINTS), []),
  streaming: optional(flag, true),
  scripts: optional(oneOf("sandboxed", "unavailable", "unconfined"), "unavailable"),
  scripts_note: optional(text, ""),
  interlocks: optional(
    list(object<InterlockDescription>({ name: text, action: oneOf("slow", "hold"), speed: number, stale_ms: count }), MAX_JOINTS),
    [],
  ),
  diagnostics: optional(list(diagnostic, MAX_JOINTS), []),
  position_m: nullable(vector3),
  base: nullable(object<BaseLimits>({ forward_m_s: number, left_m_s: number, turn_rad_s: number })),
});

const geometry = object<Geometry>({
  shape: oneOf("box", "sphere", "capsule", "cylinder", "ellipsoid", "plane"),
  size_m: vector3,
  position_m: vector3,
  quaternion,
  rgba: quaternion,
});

const twinJoint = object<Required<TwinJoint>>({
  name: text,
  kind: oneOf("hinge", "slide"),
  axis: vector3,
  anchor_m: vector3,
  reference_rad: optional(number, 0),
  follows: optional(byName, {}),
});

const body = object<Required<Body>>({
  name: text,
  parent: number,
  position_m: vector3,
  quaternion,
  joint: nullable<TwinJoint>(twinJoint),
  geometries: optional(list(geometry, MAX_BODIES), []),
});

const twin = object<{ device: string; bodies: Required<Body>[] }>({ device: text, bodies: list(body, MAX_BODIES) });

const state = object<Required<State>>({
  device: text,
  at_ms: count,
  tick_ms: count,
  mode,
  epoch: count,
  ended_epoch: optional(count, 0),
  stop: nullable(object<Required<StopLatch>>({ caller: text, reason: text, at_ms: count, verified: optional(flag, false) })),
  lease: nullable<LeaseState>(
    object<Required<LeaseState>>({
      holder: text,
      epoch: count,
      expires_in_ms: count,
      reason: optional(text, ""),
      request: nullable(object<OpenRequest>({ id: text, requester: text, expires_in_ms: count })),
    }),
  ),
  action: nullable<ActionState>(
    object<Required<ActionState>>({
      id: text,
      kind: text,
      name: optional(text, ""),
      progress: optional(number, 0),
    }),
  ),
  faults: optional(list(object<Fault>({ code: text, message: text, since_ms: count, count: optional(count, 1), last_ms: optional(count, 0) }), MAX_JOINTS), []),
  restrictions: optional(list(object<Restriction>({ source: text, speed: number, reason: text }), MAX_JOINTS), []),
  stiffness: optional(byName, {}),
  load: optional(count, 0),
  rates_hz: optional(byName, {}),
  recording: optional(flag, false),
  recorded_cameras: optional(list(text, MAX_JOINTS), []),
  camera_consent: nullable(
    object<Required<CameraConsent>>({
      cameras: optional(list(text, MAX_JOINTS), []),
      by: optional(text, ""),
      at_ms: optional(count, 0),
      number: optional(count, 0),
    }),
  ),
});

const measured = list(number, MAX_JOINTS);

const jointTelemetry = object<Required<JointTelemetry>>({
  tick_ms: count,
  at_ms: count,
  sequence: count,
  mode,
  position_rad: measured,
  velocity_rad_s: measured,
  effort_nm: measured,
  commanded_rad: measured,
  frames: optional(list(pose, MAX_JOINTS), []),
  epoch: optional(count, 0),
  setpoint_sequence: optional(count, 0),
  setpoint_sent_ms: optional(number, 0),
  loop_age_ms: optional(number, 0),
  ended_input: optional(count, 0),
  limited: optional(list(text, MAX_JOINTS), []),
});

/** Numbers and states by name. */
const values: Check<Record<string, number | boolean>> = (value, at, key) => {
  const entries = Object.entries(record(value, at, key));
  if (entries.length > MAX_JOINTS) fail(at, `at most ${MAX_JOINTS} values`, key);
  const here = pathOf(at, key);
  return Object.fromEntries(
    entries.map(([name, entry]) => [name, typeof entry === "boolean" ? entry : number(entry, here, name)]),
  );
};

const measurements = object<Measurements>({ tick_ms: count, at_ms: count, sequence: count, values });

const event = object<Required<Event>>({
  id: text,
  device: text,
  at_ms: count,
  kind: text,
  severity: oneOf("info", "warning", "error"),
  message: text,
  data: optional(record, {}),
});

const ack = object<Required<Ack>>({
  id: text,
  status: oneOf<AckStatus>("received", "accepted", "started", "done", "failed", "expired", "cancelled"),
  sequence: count,
  at_ms: count,
  tick_ms: count,
  reason: nullable(object<Reason>({ code: text, message: text, epoch: optional(count, 0) })),
  progress: nullable(number),
  output: optional(text, ""),
  result: optional(record, {}),
  traceparent: optional(text, ""),
});

const decoder = new TextDecoder("utf-8", { fatal: true });

function read<T>(payload: Uint8Array, check: Check<T>, name: string): T {
  if (payload.byteLength > MAX_BYTES) throw new MessageError(`${name} is longer than ${MAX_BYTES} bytes`);
  let value: unknown;
  try {
    value = JSON.parse(decoder.decode(payload));
  } catch {
    throw new MessageError(`${name} is not JSON`);
  }
  return check(value, name);
}

export type KnownDiagnostic = Required<Diagnostic>;

export type KnownDescription = Required<Omit<Description, "cameras" | "diagnostics" | "mimic_joints" | "robot_behaviours">> & {
  cameras: Required<CameraStream>[];
  robot_behaviours: Required<RobotBehaviour>[];
  diagnostics: KnownDiagnostic[];
  mimic_joints: Required<MimicJoint>[];
};

export type KnownBody = Required<Body>;

export interface KnownTwin {
  device: string;
  bodies: KnownBody[];
}

export type KnownState = Required<State>;

export type KnownTelemetry = Required<JointTelemetry>;

export type KnownAck = Required<Ack>;

export type KnownEvent = Required<Event>;

/** `conn`. Throws `MessageError`. */
export function readPresence(payload: Uint8Array): Required<Presence> {
  return read(payload, presence, "conn");
}

/** `desc`. Joint ranges must be valid and names unique. Throws `MessageError`. */
export function readDescription(payload: Uint8Array): KnownDescription {
  const found = read(payload, description, "desc");
  for (const one of found.joints) {
    if (one.lower_rad >= one.upper_rad) fail(`desc: range of ${one.name}`, "a range");
  }
  if (new Set(found.joints.map((one) => one.name)).size !== found.joints.length) fail("desc.joints", "of distinct names");
  return found;
}

/** `desc/twin`. Parents precede their children, so that one pass builds the tree. Throws `MessageError`. */
export function readTwin(payload: Uint8Array): KnownTwin {
  const found = read(payload, twin, "twin");
  found.bodies.forEach((one, index) => {
    if (!Number.isInteger(one.parent) || one.parent < -1 || one.parent >= index) {
      fail(`twin.bodies[${index}].parent`, "the index of an earlier body");
    }
    if (Math.hypot(...one.quaternion) < 1e-6) fail(`twin.bodies[${index}].quaternion`, "a rotation");
    if (one.joint !== null && Math.hypot(...one.joint.axis) < 1e-6) fail(`twin.bodies[${index}].joint.axis`, "an axis");
  });
  return found;
}

/** `state`. Throws `MessageError`. */
export function readState(payload: Uint8Array): KnownState {
  return read(payload, state, "state");
}

/** `tele/joints`. All four lists have the same length. Throws `MessageError`. */
export function readTelemetry(payload: Uint8Array): KnownTelemetry {
  const found = read(payload, jointTelemetry, "telemetry");
  const length = found.position_rad.length;
  for (const name of ["velocity_rad_s", "effort_nm", "commanded_rad"] as const) {
    if (found[name].length !== length) fail(`telemetry.${name}`, `a list of ${length} numbers`);
  }
  return found;
}

/** `tele/{stream}`, except `joints`. Throws `MessageError`. */
export function readMeasurements(payload: Uint8Array): Measurements {
  return read(payload, measurements, "measurements");
}

/** The result of `shoot`: the values of each stream. Throws `MessageError`. */
export function readShot(result: unknown): Record<string, Record<string, number | boolean>> {
  const streams = Object.entries(record(record(result, "result")["values"], "result.values"));
  return Object.fromEntries(streams.map(([name, entry]) => [name, values(entry, `result.values.${name}`)]));
}

/** The result of `set_control`: the applied values. Throws `MessageError`. */
export function readApplied(result: unknown): Record<string, number> {
  return byName(record(result, "result")["applied"], "result.applied");
}

/** `event`. Throws `MessageError`. */
export function readEvent(payload: Uint8Array): KnownEvent {
  return read(payload, event, "event");
}

/** `ack`. Throws `MessageError`. */
export function readAck(payload: Uint8Array): KnownAck {
  return read(payload, ack, "ack");
}
