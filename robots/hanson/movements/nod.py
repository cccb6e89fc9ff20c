"""Nod a few times."""

PARAMETERS = {
    "times": {"type": "integer", "minimum": 1, "maximum": 20, "default": 3, "description": "How often to nod"},
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 1,
        "default": 0.6,
        "description": "Share of the joints' velocity limits",
    },
}

times = min(20, max(1, int(parameters.get("times", 3))))
speed = float(parameters.get("speed", 0.6))


def pitch(motor_rad):
    """Tilt the head forward: both motors of the upper gimbal by the same angle in opposite directions."""
    robot.move_joints({"Upper-Gimbal-L": motor_rad, "Upper-Gimbal-R": -motor_rad}, speed=speed)


for count in range(times):
    pitch(0.9)
    pitch(-0.3)
    progress((count + 1) / times)
pitch(0.0)
