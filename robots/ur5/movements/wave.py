"""Raise the arm, wave with the wrist, and go home."""

PARAMETERS = {
    "times": {"type": "integer", "minimum": 1, "maximum": 20, "default": 3, "description": "How often to wave"},
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

robot.home(speed=speed)
robot.move_joints({"shoulder_lift": -1.75, "elbow": 0.75, "wrist_1": -0.55, "wrist_2": -1.57}, speed=speed)
for count in range(times):
    robot.move_joints({"elbow": 0.35, "wrist_1": -0.95}, speed=speed)
    robot.move_joints({"elbow": 1.15, "wrist_1": -0.15}, speed=speed)
    progress((count + 1) / times)
robot.home(speed=speed)
