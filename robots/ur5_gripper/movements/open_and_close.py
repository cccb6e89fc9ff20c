"""Open and close the gripper, and print whether it holds something."""

PARAMETERS = {
    "times": {"type": "integer", "minimum": 1, "maximum": 20, "default": 2, "description": "How often to close"}
}

times = min(20, max(1, int(parameters.get("times", 2))))

robot.home(speed=0.5)
for count in range(times):
    robot.set_control("gripper", 0.0)
    closed = robot.set_control("gripper", 1.0)
    print("closed to", round(100 * closed), "%")
    progress((count + 1) / times)
robot.set_control("gripper", 0.0)
