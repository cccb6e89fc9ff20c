"""Raise the forearm, wave with it, and go home."""

PARAMETERS = {
    "times": {"type": "integer", "minimum": 1, "maximum": 20, "default": 3, "description": "How often to wave"}
}

times = min(20, max(1, int(parameters.get("times", 3))))

robot.home(speed=0.3)
robot.move_joints({"elbow_flex": -1.2, "wrist_flex": -0.2, "gripper": 0.8}, speed=0.3)
for count in range(times):
    robot.move_joints({"shoulder_pan": 0.4, "wrist_roll": 0.3}, speed=0.3)
    robot.move_joints({"shoulder_pan": -0.4, "wrist_roll": -0.3}, speed=0.3)
    progress((count + 1) / times)
robot.home(speed=0.3)
