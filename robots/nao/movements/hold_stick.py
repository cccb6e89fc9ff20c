"""Grasp a stick that lies across a rack with the right hand, lift it, and hold it."""

import math

PARAMETERS = {
    "object": {"type": "string", "default": "stick", "description": "Name in the stream objects"},
    "hold_s": {
        "type": "number",
        "minimum": 0,
        "maximum": 30,
        "default": 2,
        "unit": "s",
        "description": "How long the hand keeps it before the movement ends",
    },
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 0.5,
        "default": 0.15,
        "description": "Share of the joints' velocity limits",
    },
}

# The arm moves in the vertical plane of the shoulder. Lengths as in README.md.
SHOULDER_X_M, SHOULDER_Z_M, ELBOW_Y_M = 0.0, 0.1, -0.113
UPPER_M, FORE_M = 0.105, 0.05595
GRIP_M = (0.0745, -0.0158)  # where the hand grasps, forward of and above the wrist
MOUTH = (0.775, -0.632)  # the direction in which the open hand receives the stick
AWAY_M = (0.03, 0.015, 0.0)
BESIDE_M = 0.03  # the stick may be this far beside the plane
SOFT = 0.9  # a joint with reduced stiffness may stop at an object
EMPTY = 0.2  # a hand that closes further holds nothing
LIFT_RAD = 0.85
TRIES = 2
OLD_S = 1.0

name = str(parameters.get("object", "stick"))
hold_s = min(30.0, max(0.0, float(parameters.get("hold_s", 2))))
speed = min(0.5, max(0.05, float(parameters.get("speed", 0.15))))


def locate():
    """Position x, y, z [m] of the stick in the frame of the torso. Ends the script if it is not measured."""
    found = robot.state()["streams"].get("objects")
    if found is None or found["age_s"] > OLD_S:
        raise RobotError("there is no measurement of objects; a real robot needs a camera that measures poses")
    if f"x_m.{name}" not in found["values"]:
        known = sorted(field[4:] for field in found["values"] if field.startswith("x_m."))
        raise RobotError(f"no object '{name}' is measured; there are: {', '.join(known)}")
    return [found["values"][f"{axis}_m.{name}"] for axis in "xyz"]


def reach(pitch_rad, roll_rad, point_m):
    """Forward and upward position [m] of a point of the hand."""
    hand_rad = pitch_rad - roll_rad
    forward_m, up_m = FORE_M + point_m[0], point_m[1]
    return (
        SHOULDER_X_M + UPPER_M * math.cos(pitch_rad) + forward_m * math.cos(hand_rad) + up_m * math.sin(hand_rad),
        SHOULDER_Z_M - UPPER_M * math.sin(pitch_rad) - forward_m * math.sin(hand_rad) + up_m * math.cos(hand_rad),
    )


def solve(x_m, z_m, point_m):
    """Shoulder pitch and elbow roll [rad] that bring a point of the hand to a place; the elbow is the lower one."""
    length_m, tilt_rad = math.hypot(FORE_M + point_m[0], point_m[1]), math.atan2(point_m[1], FORE_M + point_m[0])
    x_m, z_m = x_m - SHOULDER_X_M, z_m - SHOULDER_Z_M
    away_m = math.hypot(x_m, z_m)
    cosine = (away_m**2 - UPPER_M**2 - length_m**2) / (2 * UPPER_M * length_m)
    if abs(cosine) > 1:
        raise RobotError(f"'{name}' is out of the arm's reach: {1000 * away_m:.0f} mm from the shoulder")
    bend_rad = math.acos(cosine)
    pitch_rad = math.atan2(-z_m, x_m) + math.atan2(length_m * math.sin(bend_rad), UPPER_M + length_m * cosine)
    return pitch_rad, bend_rad - tilt_rad


def move(pitch_rad, roll_rad, share):
    """Move the arm in its plane, with the thumb below."""
    target = {"RShoulderPitch": pitch_rad, "RShoulderRoll": 0.0, "RElbowYaw": math.pi / 2, "RElbowRoll": roll_rad}
    robot.move_joints({**target, "RWristYaw": -math.pi / 2}, speed=speed * share)


def close():
    """Close the hand; returns whether something stopped it."""
    robot.move_joints({"RHand": 0.0}, speed=speed)
    wait(0.5)
    return robot.state()["position_rad"]["RHand"] > EMPTY


def grasp():
    """Move the open hand around the stick, and close it."""
    x, y, z = locate()
    if abs(y - ELBOW_Y_M) > BESIDE_M:
        raise RobotError(f"'{name}' is {1000 * abs(y - ELBOW_Y_M):.0f} mm beside the arm's plane")
    robot.move_joints({"RHand": 1.0}, speed=speed)
    robot.move_joints({"RShoulderPitch": 1.9}, speed=speed)  # back, and then up behind the rack
    move(1.9, 0.6, 1.0)
    move(1.9, 1.4, 1.0)
    for away_m in AWAY_M:
        point_m = [at_m + away_m * part for at_m, part in zip(GRIP_M, MOUTH, strict=True)]
        pitch_rad, roll_rad = solve(x, z, point_m)
        move(pitch_rad, roll_rad, 0.5)
    held = close()
    move(pitch_rad - LIFT_RAD, roll_rad, 0.5)
    return held and robot.state()["position_rad"]["RHand"] > EMPTY


robot.home(speed=speed)
robot.stiffness(SOFT, ["RHand"])
for attempt in range(1, TRIES + 1):
    if grasp():
        break
    print("grasp", attempt, "holds nothing")
    robot.move_joints({"RHand": 1.0}, speed=speed)
    robot.home(speed=speed)
else:
    raise RobotError(f"the hand holds nothing after {TRIES} attempts to grasp '{name}'")
progress(0.8)
wait(hold_s)
if robot.state()["position_rad"]["RHand"] <= EMPTY:
    raise RobotError(f"the hand has lost '{name}'")
print("holds", name)
