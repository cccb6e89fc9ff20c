"""Walk a few steps forward, then a square."""

PARAMETERS = {
    "side_m": {
        "type": "number",
        "minimum": 0.1,
        "maximum": 0.5,
        "default": 0.2,
        "unit": "m",
        "description": "Side of the square",
    },
    "left": {"type": "boolean", "default": True, "description": "Turn left at the corners"},
}

SPEED_M_S, TURN_RAD_S = 0.1, 0.5
SPEEDING_UP_S = 0.2  # lost by acceleration, which is slower than braking
RIGHT_ANGLE_RAD = 1.5708

side_m = min(0.5, max(0.1, float(parameters.get("side_m", 0.2))))
turn_rad_s = TURN_RAD_S if parameters.get("left", True) else -TURN_RAD_S

robot.home(speed=0.3)
robot.drive(forward_m_s=SPEED_M_S, duration_s=2.0)
for corner in range(4):
    robot.drive(forward_m_s=SPEED_M_S, duration_s=side_m / SPEED_M_S + SPEEDING_UP_S)
    robot.drive(turn_rad_s=turn_rad_s, duration_s=RIGHT_ANGLE_RAD / TURN_RAD_S + SPEEDING_UP_S)
    progress((corner + 1) / 4)
robot.home(speed=0.3)
