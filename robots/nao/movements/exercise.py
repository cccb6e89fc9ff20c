"""Knee bends with the arms held out in front, as a warm-up."""

PARAMETERS = {
    "times": {"type": "integer", "minimum": 1, "maximum": 10, "default": 2, "description": "How many knee bends"}
}

LEGS = ("HipPitch", "KneePitch", "AnklePitch")


def legs(hip, knee, ankle):
    """Move both legs equally, so that the feet stay in place."""
    return {side + name: value for side in "LR" for name, value in zip(LEGS, (hip, knee, ankle), strict=True)}


times = min(10, max(1, int(parameters.get("times", 2))))
arms_out = {"LShoulderPitch": 0.3, "RShoulderPitch": 0.3, "LElbowRoll": -0.2, "RElbowRoll": 0.2}

robot.home(speed=0.3)
robot.move_joints(arms_out, speed=0.2)
for count in range(times):
    robot.move_joints(legs(-1.1, 1.7, -0.6), speed=0.15)
    robot.move_joints(legs(-0.4, 0.75, -0.35), speed=0.15)
    progress((count + 1) / times)
robot.home(speed=0.2)
