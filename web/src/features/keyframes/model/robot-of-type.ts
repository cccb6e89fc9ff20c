import type { RobotType } from "../../../shared/api/robot-types";
import type { Robot } from "./keyframes";

/** What the keyframe editor needs to know of any robot of a type. */
export function robotOf({ joints, mimic_joints, position_dependent_limits, postures, expressions, behaviours, capabilities, actions }: RobotType): Robot {
  const complete = mimic_joints.map(({ joint, mimics, multiplier = 1 }) => ({ joint, mimics, multiplier }));
  return { joints, mimic_joints: complete, position_dependent_limits, postures, expressions, behaviours, capabilities, actions };
}
