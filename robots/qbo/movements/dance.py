"""Sway from side to side with the head the other way, and finish with a turn."""

import math

PARAMETERS = {"times": {"type": "integer", "minimum": 1, "maximum": 10, "default": 2, "description": "Repetitions"}}

times = min(10, max(1, int(parameters.get("times", 2))))

for count in range(times):
    for side in (1, -1):
        robot.move_joints({"head_pan": -0.5 * side, "head_tilt": -0.2}, speed=0.5)
        robot.drive(turn_rad_s=side * 1.2, duration_s=0.7 if count + side > 1 else 0.35)
    robot.move_joints({"head_tilt": 0.2}, speed=0.5)
    progress((count + 1) / (times + 1))
robot.home(speed=0.5)
robot.drive(turn_rad_s=1.2, duration_s=2 * math.pi / 1.2)
