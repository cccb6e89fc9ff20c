"""Drive to a person or robot that the room locates, avoid obstacles, stop in front, and greet."""

import math

PARAMETERS = {
    "who": {"type": "string", "default": "person", "description": "Name in the room's positions"},
    "near_m": {
        "type": "number",
        "minimum": 0.7,
        "maximum": 2,
        "default": 0.9,
        "unit": "m",
        "description": "Distance at which it stops",
    },
    "tries": {
        "type": "integer",
        "minimum": 1,
        "maximum": 20,
        "default": 4,
        "description": "How often it follows a person who moves on",
    },
}

SIDES_RAD = (0.0, 0.7, -0.7, 1.4, -1.4)  # candidate directions, relative to the robot's own side
NEAR_M = 0.3  # tolerance for greeting a moving person
TURN_RAD_S, STRAIGHT_RAD = 0.6, 0.1
LOOK_S, PATIENCE_S = 0.3, 35.0  # waiting time for a moving person
OLD_S = 2.0

who = str(parameters.get("who", "person"))
near_m = min(2.0, max(0.7, float(parameters.get("near_m", 0.9))))
tries = min(20, max(1, int(parameters.get("tries", 4))))


def apart():
    """Distance [m], direction [rad] and position x, y [m]. Ends the script if the position is unknown."""
    found = room.latest("perception", "positions")
    if found is None or found["age_s"] > OLD_S:
        raise RobotError("the room reports no positions")
    seen = found["values"]
    for name in ("qbo", who):
        known = sorted(field[4:] for field in seen if field.startswith("x_m."))
        if f"x_m.{name}" not in seen or seen[f"age_s.{name}"] > OLD_S:
            raise RobotError(f"the room does not locate '{name}'; it locates: {', '.join(known) or 'none'}")
    x_m, y_m = seen[f"x_m.{who}"], seen[f"y_m.{who}"]
    across_m, up_m = x_m - seen["x_m.qbo"], y_m - seen["y_m.qbo"]
    return math.hypot(across_m, up_m), math.atan2(up_m, across_m), (x_m, y_m)


def near():
    """Whether the person is, or comes, in front of the robot while it waits."""
    waited_s = 0.0
    while apart()[0] > near_m + NEAR_M:
        if waited_s >= PATIENCE_S:
            return False
        wait(LOOK_S)
        waited_s += LOOK_S
    return True


def approach():
    """Drive to a free position near the person; returns whether there was one."""
    _, towards_rad, (x_m, y_m) = apart()
    for side_rad in SIDES_RAD:
        facing_rad = towards_rad + side_rad
        try:
            robot.go_to(x_m - near_m * math.cos(facing_rad), y_m - near_m * math.sin(facing_rad), facing_rad)
        except RobotError as error:
            why = error
        else:
            return
    raise why


def turn(angle_rad):
    """Turn by this angle in the shorter direction."""
    angle_rad = math.remainder(angle_rad, 2 * math.pi)
    if abs(angle_rad) > STRAIGHT_RAD:
        robot.drive(turn_rad_s=math.copysign(TURN_RAD_S, angle_rad), duration_s=abs(angle_rad) / TURN_RAD_S)


for attempt in range(tries):
    progress(attempt / tries)
    approach()
    if near():
        break
left_m, facing_rad, _ = apart()
if left_m <= near_m + NEAR_M:
    print("stopped", round(left_m, 2), "m before", who)
    robot.say("Hello!")
else:
    print("did not reach", who, "in time;", round(left_m, 2), "m remaining")
turn(facing_rad - robot.state()["streams"]["odometry"]["values"]["yaw_rad"])
robot.look([0.9, 0.0, 0.9], speed=0.4)
robot.home(speed=0.4)
