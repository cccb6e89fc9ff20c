"""Turn on the spot, head first."""

import math

PARAMETERS = {
    "turns": {"type": "number", "minimum": 0.25, "maximum": 3, "default": 1, "description": "Number of turns"},
    "left": {"type": "boolean", "default": True, "description": "Counter-clockwise"},
    "turn_rad_s": {
        "type": "number",
        "minimum": 0.2,
        "maximum": 1.5,
        "default": 1.0,
        "unit": "rad/s",
        "description": "Speed",
    },
}

turns = min(3.0, max(0.25, float(parameters.get("turns", 1))))
turn_rad_s = min(1.5, max(0.2, float(parameters.get("turn_rad_s", 1.0))))
side = 1 if parameters.get("left", True) else -1

robot.move_joints({"head_pan": side * 0.6}, speed=0.3)
quarters = max(1, round(turns * 4))
for quarter in range(quarters):
    robot.drive(turn_rad_s=side * turn_rad_s, duration_s=turns * 2 * math.pi / quarters / turn_rad_s)
    progress((quarter + 1) / quarters)
robot.home(speed=0.3)
