"""Reach with the open gripper over the green block, close it in the air, and go home."""

PARAMETERS = {
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 0.5,
        "default": 0.25,
        "description": "Share of the joints' velocity limits",
    }
}

speed = min(0.5, max(0.05, float(parameters.get("speed", 0.25))))

robot.home(speed=speed)
robot.move_joints({"shoulder_pan": -0.417, "gripper": 0.9}, speed=speed)
progress(0.3)
robot.move_joints({"shoulder_lift": 0.423, "elbow_flex": -0.065, "wrist_flex": -1.263}, speed=speed)
progress(0.6)
robot.move_joints({"gripper": 0.3}, speed=speed)
robot.home(speed=speed)
