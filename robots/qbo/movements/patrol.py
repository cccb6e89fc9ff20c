"""Drive along a square and look to both sides at each corner."""

import math

PARAMETERS = {
    "side_m": {
        "type": "number",
        "minimum": 0.2,
        "maximum": 2,
        "default": 0.5,
        "unit": "m",
        "description": "Side of the square",
    },
    "speed_m_s": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 0.3,
        "default": 0.2,
        "unit": "m/s",
        "description": "Speed",
    },
    "keep_m": {
        "type": "number",
        "minimum": 0.15,
        "maximum": 1,
        "default": 0.35,
        "unit": "m",
        "description": "Distance to obstacles at which it stops",
    },
}

STEP_M = 0.1
TURN_RAD_S = 0.8

side_m = min(2.0, max(0.2, float(parameters.get("side_m", 0.5))))
speed_m_s = min(0.3, max(0.05, float(parameters.get("speed_m_s", 0.2))))
keep_m = min(1.0, max(0.15, float(parameters.get("keep_m", 0.35))))


def room_ahead():
    """The smaller distance of both sonars [m]."""
    sonar = robot.state()["streams"].get("sonar")
    if sonar is None or sonar["age_s"] > 1.0:
        raise RobotError("no sonar data; the patrol ends")
    return min(sonar["values"]["distance_m.left"], sonar["values"]["distance_m.right"])


def along(way_m):
    """Drive forward in short steps until there is an obstacle."""
    steps = max(1, round(way_m / STEP_M))
    for _ in range(steps):
        if room_ahead() < keep_m + STEP_M:
            print("obstacle ahead; turning early")
            return
        robot.drive(forward_m_s=speed_m_s, duration_s=way_m / steps / speed_m_s)


for corner in range(4):
    along(side_m)
    for pan in (0.7, -0.7, 0.0):
        robot.move_joints({"head_pan": pan}, speed=0.4)
    robot.drive(turn_rad_s=TURN_RAD_S, duration_s=math.pi / 2 / TURN_RAD_S)
    progress((corner + 1) / 4)
