"""Open and close the gripper."""

PARAMETERS = {
    "times": {"type": "integer", "minimum": 1, "maximum": 20, "default": 2, "description": "How often to close"},
    "opening_rad": {
        "type": "number",
        "minimum": 0.2,
        "maximum": 1.7,
        "default": 1.2,
        "unit": "rad",
        "description": "Angle of the open gripper",
    },
}

times = min(20, max(1, int(parameters.get("times", 2))))
opening_rad = min(1.7, max(0.2, float(parameters.get("opening_rad", 1.2))))

for count in range(times):
    robot.move_joints({"gripper": opening_rad}, speed=0.3)
    robot.move_joints({"gripper": 0.1}, speed=0.3)
    progress((count + 1) / times)
robot.move_joints({"gripper": 0.3}, speed=0.3)
