"""Raise the right hand, wave, and go back to standing."""

PARAMETERS = {
    "times": {"type": "integer", "minimum": 1, "maximum": 20, "default": 3, "description": "How often to wave"},
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 0.6,
        "default": 0.3,
        "description": "Share of the joints' velocity limits",
    },
}

times = min(20, max(1, int(parameters.get("times", 3))))
speed = min(0.6, max(0.05, float(parameters.get("speed", 0.3))))

robot.home(speed=0.3)
robot.move_joints(
    {
        "RShoulderPitch": -0.9,
        "RShoulderRoll": -0.35,
        "RElbowYaw": 1.0,
        "RElbowRoll": 0.9,
        "RWristYaw": 0.3,
        "RHand": 0.9,
        "HeadYaw": -0.25,
    },
    speed=speed,
)
for count in range(times):
    robot.move_joints({"RElbowRoll": 1.4}, speed=speed)
    robot.move_joints({"RElbowRoll": 0.5}, speed=speed)
    progress((count + 1) / times)
robot.home(speed=0.3)
