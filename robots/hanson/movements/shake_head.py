"""Shake the head: no."""

PARAMETERS = {
    "times": {"type": "integer", "minimum": 1, "maximum": 20, "default": 2, "description": "Repetitions"},
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 1,
        "default": 0.6,
        "description": "Share of the joints' velocity limits",
    },
}

times = min(20, max(1, int(parameters.get("times", 2))))
speed = float(parameters.get("speed", 0.6))

for count in range(times):
    robot.move_joints({"Neck-Rotation": 0.4}, speed=speed)
    robot.move_joints({"Neck-Rotation": -0.4}, speed=speed)
    progress((count + 1) / times)
robot.move_joints({"Neck-Rotation": 0.0}, speed=speed)
