/** The head of `tests/fakes/head_driver.py`, as the keyframe editor reads it. */
import type { Robot } from "../../src/features/keyframes/model/keyframes";

const RANGES = { yaw: [-2, 2], pitch: [-0.7, 0.5], left: [-1, 0.5], right: [-0.25, 0.5] } as const;

export function head(): Robot {
  return {
    joints: Object.entries(RANGES).map(([name, [lower_rad, upper_rad]]) => ({
      name, label: name, lower_rad, upper_rad, max_velocity_rad_s: 4, max_acceleration_rad_s2: 10, max_jerk_rad_s3: 100,
      max_effort_nm: 5,
    })),
    mimic_joints: [{ joint: "right", mimics: "left", multiplier: -0.5 }],
    position_dependent_limits: [
      {
        joint: "pitch",
        depends_on: "yaw",
        table: [[-2, -0.4, 0.1], [-0.5, -0.7, 0.5], [0.5, -0.7, 0.5], [2, -0.4, 0.1]],
      },
    ],
    postures: ["Rest"],
    expressions: ["smile"],
    behaviours: [],
    capabilities: ["joints", "speech"],
    actions: ["move_joints", "say", "express", "take_posture", "drive", "go_to", "set_control"],
    controls: [{ name: "gripper", label: "Gripper", unit: "mm", lower: 0, upper: 85 }],
  };
}
