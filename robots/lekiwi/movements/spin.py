"""Turn on the spot."""

import math

PARAMETERS = {
    "turns": {"type": "number", "minimum": 0.25, "maximum": 3, "default": 1, "description": "Number of turns"},
    "left": {"type": "boolean", "default": True, "description": "Counter-clockwise"},
}

TURN_RAD_S = 0.8

turns = min(3.0, max(0.25, float(parameters.get("turns", 1))))
side = 1 if parameters.get("left", True) else -1

robot.home(speed=0.3)
quarters = max(1, round(turns * 4))
for quarter in range(quarters):
    robot.drive(turn_rad_s=side * TURN_RAD_S, duration_s=turns * 2 * math.pi / quarters / TURN_RAD_S)
    progress((quarter + 1) / quarters)
