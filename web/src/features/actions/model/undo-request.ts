/** The undo request of an action, from the device's reported state at the click. */
import type { DeviceStore } from "../../devices/model";
import { clamp } from "../../../shared/lib/angles";
import type { AnyRequest } from "../../../shared/api/action-requests";

/** Actions that change the joint positions. */
const JOINTS: ReadonlySet<AnyRequest["kind"]> = new Set([
  "move_joints",
  "move_pose",
  "take_posture",
  "express",
  "look_at",
  "run_behaviour",
  "run_movement",
  "run_trial",
]);

/** The request that reverses `request`; `null`: it is not reversible, or the device's pose is unknown. */
export function undoRequestOf(device: DeviceStore, request: AnyRequest): AnyRequest | null {
  if (request.kind === "set_stiffness") return stiffnessBefore(device, request.joints ?? []);
  const { telemetry, description } = { telemetry: device.telemetry.value, description: device.description.value };
  const reversible = JOINTS.has(request.kind) && description?.actions.includes("move_joints") === true;
  if (!reversible || telemetry === null || !device.live.value) return null;
  const positions = description.joints.flatMap((joint, index) => {
    const measured = telemetry.message.position_rad[index];
    // A servo may settle slightly outside its range: clamp, so that the undo request is accepted.
    return measured === undefined ? [] : [[joint.name, clamp(measured, joint.lower_rad, joint.upper_rad)] as const];
  });
  return { kind: "move_joints", position_rad: Object.fromEntries(positions), plan: true };
}

/** Only if all joints had the same stiffness: one request sets one value. */
function stiffnessBefore(device: DeviceStore, joints: readonly string[]): AnyRequest | null {
  const state = device.state.value;
  const names = joints.length > 0 ? joints : (device.description.value?.joints ?? []).map(({ name }) => name);
  const values = new Set(names.map((name) => state?.stiffness[name] ?? 1));
  const [value] = values;
  if (state === null || values.size !== 1 || value === undefined) return null;
  return { kind: "set_stiffness", value, joints: [...joints] };
}
