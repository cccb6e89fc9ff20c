"""Grasp an upright peg, align it with a hole, and insert it; search around the hole when it meets the edge."""

import math

PARAMETERS = {
    "peg": {"type": "string", "default": "peg", "description": "Name of the peg in the stream objects"},
    "hole": {"type": "string", "default": "hole_block", "description": "Name of the block with the hole in its center"},
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 1,
        "default": 0.5,
        "description": "Share of the joints' velocity limits",
    },
}

OVER_M = 0.10
TOP_M = 0.02  # the fingers grasp the peg this far below its upper end
LOWEST_M = 0.024  # the fingertips keep 10 mm and some reserve from the table
ABOVE_M = 0.003  # the peg starts this far above the hole
STEP_M, STEPS = 0.004, 10  # the peg falls the rest of the way
PRESSED_NM = 5.0  # such a change of a joint's effort in one step means that the peg stands on the edge
SEARCH_M, TURNS, POINTS = 0.0007, 3, 6  # rings around the hole: distance, number, points on each
OPEN, EMPTY = 0.05, 0.97  # fingers that close less are jammed; fingers that close further hold nothing
TRIES = 2
OLD_S = 1.0

peg_name, hole_name = str(parameters.get("peg", "peg")), str(parameters.get("hole", "hole_block"))
speed = min(1.0, max(0.05, float(parameters.get("speed", 0.5))))


def stream(kind):
    """Newest values of a stream. Ends the script if there are none."""
    found = robot.state()["streams"].get(kind)
    if found is None or found["age_s"] > OLD_S:
        raise RobotError(f"there is no measurement of {kind}; a real robot needs a camera that measures poses")
    return found["values"]


def locate(name):
    """Position x, y, z [m], rotation [rad] and height [m] of an object in the frame of the base."""
    values = stream("objects")
    if f"x_m.{name}" not in values:
        known = sorted(field[4:] for field in values if field.startswith("x_m."))
        raise RobotError(f"no object '{name}' is measured; there are: {', '.join(known)}")
    return [values[f"{field}.{name}"] for field in ("x_m", "y_m", "z_m", "yaw_rad", "height_m")]


def now():
    """Position x, y, z [m] and rotation [rad] of the point between the fingers."""
    px, py, pz, w, x, y, z = robot.state()["frames"]["grip"]
    return px, py, pz, math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def nearest(yaw_rad, to_rad):
    """The rotation nearest to another one at which a square has the same sides."""
    return yaw_rad + math.pi / 2 * round((to_rad - yaw_rad) / (math.pi / 2))


def face(x_m, y_m):
    """Turn the base joint until the arm points to a place, so that the arm reaches it without large turns."""
    at_m = robot.state()["frames"]["grip"]
    turn_rad = math.remainder(math.atan2(y_m, x_m) - math.atan2(at_m[1], at_m[0]), 2 * math.pi)
    pan_rad = robot.state()["position_rad"]["shoulder_pan"] + turn_rad
    robot.move_joints({"shoulder_pan": pan_rad}, speed=speed)


def go(position_m, yaw_rad, share, straight=True):
    """Move the point between the fingers, which point down."""
    robot.move_to(position_m, rpy_rad=[math.pi, 0, yaw_rad], frame="grip", speed=speed * share, straight=straight)


def holds():
    """Whether the fingers press on something."""
    return bool(stream("gripper")["holds"])


def surround(position_m, turn_rad):
    """Move the open fingers from above around the peg."""
    go([*position_m[:2], position_m[2] + OVER_M], turn_rad, 1.0, straight=False)
    go(position_m, turn_rad, 0.4)


def grasp():
    """Grasp and lift the peg; returns whether the gripper holds it."""
    x, y, z, yaw_rad, height_m = locate(peg_name)
    face(x, y)
    grip_m, turn_rad = max(z + height_m / 2 - TOP_M, LOWEST_M), nearest(yaw_rad, now()[3])
    try:
        surround([x, y, grip_m], turn_rad)
    except RobotError:  # an obstacle is in the way: the peg is square, and the other sides may be free
        turn_rad += math.copysign(math.pi / 2, now()[3] - turn_rad)
        surround([x, y, grip_m], turn_rad)
    closed = robot.set_control("gripper", 1.0)
    go([x, y, grip_m + OVER_M], turn_rad, 0.4)
    wait(0.2)
    return OPEN < closed < EMPTY and holds()


def aligned(offset_m, tip_m):
    """Pose of the gripper with the lower end of the peg at a height, beside the hole by an offset x, y [m].

    It uses the measured pose of the peg in the gripper, so an inexact grasp does no harm.
    """
    x, y, z, turn_rad = now()
    peg_x, peg_y, peg_z, peg_rad, height_m = locate(peg_name)
    hole_x, hole_y, _, hole_rad, _ = locate(hole_name)
    rotation_rad = nearest(hole_rad, peg_rad) - peg_rad
    cos, sin = math.cos(rotation_rad), math.sin(rotation_rad)
    dx, dy = x - peg_x, y - peg_y
    target_m = [
        hole_x + offset_m[0] + cos * dx - sin * dy,
        hole_y + offset_m[1] + sin * dx + cos * dy,
        tip_m + z - peg_z + height_m / 2,
    ]
    return target_m, turn_rad + rotation_rad


def descend(position_m, turn_rad, length_m):
    """One step down; returns whether the arm then presses on something."""
    before = robot.state()["effort_nm"]
    go([*position_m[:2], position_m[2] - length_m], turn_rad, 0.15)
    wait(0.05)
    after = robot.state()["effort_nm"]
    return max(abs(after[joint] - before[joint]) for joint in before) > PRESSED_NM


def insert(offset_m, top_m):
    """Lower the peg by steps; returns whether it is in the hole. If it presses on the edge, lift it again."""
    start_m, turn_rad = aligned(offset_m, top_m + ABOVE_M)
    go(start_m, turn_rad, 0.3)
    wait(0.1)
    start_m, turn_rad = aligned(offset_m, top_m + ABOVE_M)
    go(start_m, turn_rad, 0.1)
    wait(0.1)
    for step in range(STEPS):
        if descend([*start_m[:2], start_m[2] - step * STEP_M], turn_rad, STEP_M):
            go(start_m, turn_rad, 0.15)
            return False
    return True


def offsets():
    """Points around the hole: the center, then rings."""
    yield 0.0, 0.0
    for ring in range(1, TURNS + 1):
        for point in range(POINTS):
            angle_rad = 2 * math.pi * (point + ring / 2) / POINTS
            yield ring * SEARCH_M * math.cos(angle_rad), ring * SEARCH_M * math.sin(angle_rad)


robot.home(speed=speed)
robot.set_control("gripper", 0.0)
for attempt in range(1, TRIES + 1):
    held = grasp()
    progress(0.3)
    if held:
        break
    print("grasp", attempt, "holds nothing")
    robot.set_control("gripper", 0.0)
else:
    robot.home(speed=speed)
    raise RobotError(f"the gripper holds nothing after {TRIES} attempts to grasp '{peg_name}'")
_, _, hole_z, _, hole_m = locate(hole_name)
over_m, turn_rad = aligned((0.0, 0.0), hole_z + hole_m / 2 + OVER_M / 2)
go(over_m, turn_rad, 0.6, straight=False)
for number, offset_m in enumerate(offsets()):
    inserted = insert(offset_m, hole_z + hole_m / 2)
    if inserted or not holds():
        break
    print("the peg met the edge at point", number)
x, y, z, turn_rad = now()
if not inserted:  # the gripper keeps the peg: it must not fall on the block
    go([x, y, z + OVER_M], turn_rad, 0.4)
    robot.home(speed=speed)
    raise RobotError(f"'{peg_name}' was not inserted: no point around the hole has let it in, or the gripper lost it")
robot.set_control("gripper", 0.0)
go([x, y, z + OVER_M], turn_rad, 0.4)
robot.home(speed=speed)
print("inserted", peg_name)
