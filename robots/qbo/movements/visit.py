"""Go to somebody whom the room sees, stop before them, and greet: the room tells where they are."""

import math

PARAMETERS = {
    "who": {"type": "string", "default": "person", "description": "As the room's positions call them"},
    "near_m": {
        "type": "number",
        "minimum": 0.6,
        "maximum": 2,
        "default": 0.9,
        "unit": "m",
        "description": "It stops this far from them",
    },
    "speed_m_s": {
        "type": "number",
        "minimum": 0.15,
        "maximum": 0.3,
        "default": 0.2,
        "unit": "m/s",
        "description": "How fast",
    },
    "keep_m": {
        "type": "number",
        "minimum": 0.15,
        "maximum": 1,
        "default": 0.35,
        "unit": "m",
        "description": "It stops this far from what its sonars hear",
    },
}

STEP_M = 0.3
STEPS = 20
TURN_RAD_S = 0.6
STRAIGHT_RAD, THERE_M = 0.05, 0.1
TELLING_M = 0.2  # so far it must go for the room to know where it looks
SETTLE_S = 0.3
OLD_S = 2.0

who = str(parameters.get("who", "person"))
near_m = min(2.0, max(0.6, float(parameters.get("near_m", 0.9))))
speed_m_s = min(0.3, max(0.15, float(parameters.get("speed_m_s", 0.2))))
keep_m = min(1.0, max(0.15, float(parameters.get("keep_m", 0.35))))


def places():
    """What the room says of where everybody is; the script ends where that is old."""
    found = room.latest("perception", "positions")
    if found is None or found["age_s"] > OLD_S:
        raise RobotError("the room does not say where anybody is")
    for name in ("qbo", who):
        known = sorted(field[4:] for field in found["values"] if field.startswith("x_m."))
        if f"x_m.{name}" not in found["values"] or found["values"][f"age_s.{name}"] > OLD_S:
            raise RobotError(f"the room does not see '{name}'; it sees: {', '.join(known) or 'nobody'}")
    return found["values"]


def forward(way_m):
    """Drive ahead, if the sonars hear room for it; whether they did."""
    sonar = robot.state()["streams"].get("sonar")
    if sonar is None or sonar["age_s"] > 1.0:
        raise RobotError("the sonars tell nothing; it stays where it is")
    if min(sonar["values"]["distance_m.left"], sonar["values"]["distance_m.right"]) < keep_m + way_m:
        return False
    robot.drive(forward_m_s=speed_m_s, duration_s=way_m / speed_m_s)
    return True


def turn(angle_rad):
    """Turn by so much, the shorter way round."""
    angle_rad = math.remainder(angle_rad, 2 * math.pi)
    if abs(angle_rad) > STRAIGHT_RAD:
        robot.drive(turn_rad_s=math.copysign(TURN_RAD_S, angle_rad), duration_s=abs(angle_rad) / TURN_RAD_S)


def looks():
    """Where it looks, as the room saw it go [rad]."""
    wait(SETTLE_S)
    seen = places()
    if "yaw_rad.qbo" not in seen:
        raise RobotError("the room has not seen it drive")
    return seen["yaw_rad.qbo"]


if not forward(STEP_M):
    raise RobotError("there is no room ahead to begin with")
yaw_rad = looks()
for step in range(STEPS):
    seen = places()
    across_m, up_m = seen[f"x_m.{who}"] - seen["x_m.qbo"], seen[f"y_m.{who}"] - seen["y_m.qbo"]
    left_m = math.hypot(across_m, up_m) - near_m
    towards_rad = math.atan2(up_m, across_m)
    turn(towards_rad - yaw_rad)
    yaw_rad = towards_rad
    if left_m < THERE_M:
        print("stands", round(left_m + near_m, 2), "m before", who)
        robot.look([0.9, 0.0, 0.9], speed=0.4)
        robot.say("Hello!")
        break
    progress(step / STEPS)
    if not forward(min(STEP_M, left_m)):
        print("something is in the way,", round(left_m + near_m, 2), "m before", who)
        break
    if left_m > TELLING_M:
        yaw_rad = looks()
else:
    print("did not get there; they keep going")
robot.home(speed=0.4)
