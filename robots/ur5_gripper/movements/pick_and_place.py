"""Grasp an object, check the grasp, and place the object at a position on the table or in a tray."""

import math

PARAMETERS = {
    "object": {"type": "string", "default": "red_cube", "description": "Name in the stream objects"},
    "x_m": {
        "type": "number",
        "minimum": -0.7,
        "maximum": -0.3,
        "default": -0.5,
        "unit": "m",
        "description": "x of the place, in the frame of the base",
    },
    "y_m": {
        "type": "number",
        "minimum": -0.35,
        "maximum": 0.35,
        "default": 0.25,
        "unit": "m",
        "description": "y of the place, in the frame of the base",
    },
    "surface_m": {
        "type": "number",
        "minimum": 0,
        "maximum": 0.3,
        "default": 0.016,
        "unit": "m",
        "description": "Height of the surface at the place: 0.016 in a tray, 0 on the table",
    },
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 1,
        "default": 0.5,
        "description": "Share of the joints' velocity limits",
    },
}

# The fingertips end 12 mm below the frame `grip`, and keep 10 mm and some reserve from the table.
LOWEST_M, OVER_M = 0.024, 0.12
DROP_M = 0.002  # from here the object falls
OPEN, EMPTY = 0.05, 0.97  # fingers that close less are jammed; fingers that close further hold nothing
FITS_M = 0.08  # wider objects do not fit between the open fingers
TRIES = 2
OLD_S = 1.0

name = str(parameters.get("object", "red_cube"))
x_m, y_m = float(parameters.get("x_m", -0.5)), float(parameters.get("y_m", 0.25))
surface_m = max(0.0, float(parameters.get("surface_m", 0.016)))
speed = min(1.0, max(0.05, float(parameters.get("speed", 0.5))))


def stream(kind):
    """Newest values of a stream. Ends the script if there are none."""
    found = robot.state()["streams"].get(kind)
    if found is None or found["age_s"] > OLD_S:
        raise RobotError(f"there is no measurement of {kind}; a real robot needs a camera that measures poses")
    return found["values"]


def locate():
    """Position x, y, z [m], rotation [rad], length and width [m] of the object in the frame of the base."""
    values = stream("objects")
    if f"x_m.{name}" not in values:
        known = sorted(field[4:] for field in values if field.startswith("x_m."))
        raise RobotError(f"no object '{name}' is measured; there are: {', '.join(known)}")
    return [values[f"{field}.{name}"] for field in ("x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m")]


def turns(yaw_rad, length_m=0.0, width_m=0.0):
    """The two rotations of the gripper, nearest first, at which a block fits between the fingers."""
    w, x, y, z = robot.state()["frames"]["grip"][3:]
    now_rad = math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    fitting = [
        yaw_rad + quarter * math.pi / 2 for quarter in range(-4, 5) if (width_m if quarter % 2 else length_m) <= FITS_M
    ]
    if not fitting:
        raise RobotError(f"'{name}' is too wide for the fingers: {1000 * min(length_m, width_m):.0f} mm")
    return sorted(fitting, key=lambda turn_rad: abs(turn_rad - now_rad))[:2]


def go(position_m, yaw_rad, share, straight=True):
    """Move the point between the fingers, which point down."""
    robot.move_to(position_m, rpy_rad=[math.pi, 0, yaw_rad], frame="grip", speed=speed * share, straight=straight)


def descend(low_m, over_m, turn_rad):
    """Move the open fingers from above around the object."""
    go(over_m, turn_rad, 1.0, straight=False)
    go(low_m, turn_rad, 0.4)


def approach(low_m, over_m, turns_rad):
    """Descend; near an obstacle, with the fingers at the object's other sides. Returns the rotation."""
    first_rad, second_rad = turns_rad
    try:
        descend(low_m, over_m, first_rad)
    except RobotError:
        descend(low_m, over_m, second_rad)
        return second_rad
    return first_rad


def grasp():
    """Grasp and lift the object; returns the height of the grip, and whether the gripper holds it."""
    x, y, z, *sides = locate()
    low_m, over_m = [x, y, max(z, LOWEST_M)], [x, y, max(z, LOWEST_M) + OVER_M]
    turn_rad = approach(low_m, over_m, turns(*sides))
    closed = robot.set_control("gripper", 1.0)
    go(over_m, turn_rad, 0.4)
    wait(0.2)
    return low_m[2], OPEN < closed < EMPTY and stream("gripper")["holds"]


robot.home(speed=speed)
robot.set_control("gripper", 0.0)
for attempt in range(1, TRIES + 1):
    grip_m, held = grasp()
    progress(0.5)
    if held:
        break
    print("grasp", attempt, "holds nothing")
    robot.set_control("gripper", 0.0)
else:
    robot.home(speed=speed)
    raise RobotError(f"the gripper holds nothing after {TRIES} attempts to grasp '{name}'")
# The object stood on the table, z = 0, when it was grasped at this height.
place_m, over_m = [x_m, y_m, surface_m + grip_m + DROP_M], [x_m, y_m, surface_m + grip_m + OVER_M]
turn_rad = turns(0.0)[0]
go(over_m, turn_rad, 0.6, straight=False)
if not stream("gripper")["holds"]:
    robot.home(speed=speed)
    raise RobotError(f"the gripper has lost '{name}' on the way")
go(place_m, turn_rad, 0.4)
robot.set_control("gripper", 0.0)
go(over_m, turn_rad, 0.4)
print("placed", name)
robot.home(speed=speed)
