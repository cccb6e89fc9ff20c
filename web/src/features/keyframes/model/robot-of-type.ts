import type { RobotType } from "../../../shared/api/robot-types";
import type { Robot } from "./keyframes";

/** The robot properties that the keyframe editor uses, from a robot type. */
export function robotOf({ joints, mimic_joints, position_dependent_limits, postures, expressions, behaviours, capabilities, actions }: RobotType): Robot {
  const complete = mimic_joints.map(({ joint, mimics, multiplier = 1 }) => ({ joint, mimics, multiplier }));
  return { joints, mimic_joints: complete, position_dependent_limits, postures, expressions, behaviours, capabilities, actions, controls: null };
}
