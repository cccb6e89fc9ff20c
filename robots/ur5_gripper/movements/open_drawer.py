"""Grasp the handle of a drawer from above, pull the drawer open, and check how far it is open."""

import math

PARAMETERS = {
    "drawer": {"type": "string", "default": "drawer", "description": "Name in the stream objects"},
    "opening_m": {
        "type": "number",
        "minimum": 0.02,
        "maximum": 0.19,
        "default": 0.18,
        "unit": "m",
        "description": "How far the drawer is open at the end",
    },
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 1,
        "default": 0.5,
        "description": "Share of the joints' velocity limits",
    },
}

OVER_M = 0.1
NEAR_M = 0.015  # the drawer may stay this far from the requested opening
OPEN, EMPTY = 0.05, 0.97  # fingers that close less are jammed; fingers that close further hold nothing
TRIES = 3
OLD_S = 1.0

name = str(parameters.get("drawer", "drawer"))
opening_m = min(0.19, max(0.02, float(parameters.get("opening_m", 0.18))))
speed = min(1.0, max(0.05, float(parameters.get("speed", 0.5))))


def stream(kind):
    """Newest values of a stream. Ends the script if there are none."""
    found = robot.state()["streams"].get(kind)
    if found is None or found["age_s"] > OLD_S:
        raise RobotError(f"there is no measurement of {kind}; a real robot needs a camera that measures poses")
    return found["values"]


def locate():
    """Position x, y, z [m] and rotation [rad] of the handle, and how far the drawer is open [m]."""
    values = stream("objects")
    if f"position.{name}" not in values:
        known = sorted(field.removeprefix("position.") for field in values if field.startswith("position."))
        raise RobotError(f"no drawer '{name}' is measured; there are: {', '.join(known)}")
    return [values[f"{field}.{name}"] for field in ("x_m", "y_m", "z_m", "yaw_rad", "position")]


def face(x_m, y_m):
    """Turn the base joint until the arm points to a place, so that the arm reaches it without large turns."""
    at_m = robot.state()["frames"]["grip"]
    turn_rad = math.remainder(math.atan2(y_m, x_m) - math.atan2(at_m[1], at_m[0]), 2 * math.pi)
    pan_rad = robot.state()["position_rad"]["shoulder_pan"] + turn_rad
    robot.move_joints({"shoulder_pan": pan_rad}, speed=speed)


def go(position_m, yaw_rad, share, straight=True):
    """Move the point between the fingers, which point down."""
    robot.move_to(position_m, rpy_rad=[math.pi, 0, yaw_rad], frame="grip", speed=speed * share, straight=straight)


def nearest(yaw_rad):
    """The rotation of the gripper nearest to the present one at which the fingers are beside the handle."""
    w, x, y, z = robot.state()["frames"]["grip"][3:]
    now_rad = math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    across_rad = yaw_rad + math.pi / 2
    return across_rad + math.pi * round((now_rad - across_rad) / math.pi)


def pull():
    """Grasp the handle, and pull it as far as is missing. The handle is along x of the drawer, which opens to -x."""
    x, y, z, yaw_rad, open_m = locate()
    face(x, y)
    turn_rad = nearest(yaw_rad)
    go([x, y, z + OVER_M], turn_rad, 1.0, straight=False)
    go([x, y, z], turn_rad, 0.4)
    closed = robot.set_control("gripper", 1.0)
    if OPEN < closed < EMPTY and stream("gripper")["holds"]:
        way_m = opening_m - open_m
        x, y = x - way_m * math.cos(yaw_rad), y - way_m * math.sin(yaw_rad)
        go([x, y, z], turn_rad, 0.3)
    robot.set_control("gripper", 0.0)
    go([x, y, z + OVER_M], turn_rad, 0.4)


robot.home(speed=speed)
robot.set_control("gripper", 0.0)
for attempt in range(1, TRIES + 1):
    pull()
    progress(attempt / (TRIES + 1))
    open_m = locate()[-1]
    if open_m >= opening_m - NEAR_M:
        break
    print("the drawer is open by", round(1000 * open_m), "mm after attempt", attempt)
robot.home(speed=speed)
if open_m < opening_m - NEAR_M:
    raise RobotError(f"the drawer is open by {1000 * open_m:.0f} mm only, after {TRIES} attempts")
print("opened", name, "by", round(1000 * open_m), "mm")
