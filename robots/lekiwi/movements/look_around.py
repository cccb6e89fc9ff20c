"""Turn the gripper left, right, up and down, as a camera on it would look around."""

PARAMETERS = {
    "pause_s": {
        "type": "number",
        "minimum": 0,
        "maximum": 5,
        "default": 0.5,
        "unit": "s",
        "description": "Pause in each direction",
    }
}

pause_s = min(5.0, max(0.0, float(parameters.get("pause_s", 0.5))))
directions = [(0.8, 0.4), (0.0, 0.8), (-0.8, 0.4), (0.0, -0.5)]

robot.home(speed=0.3)
for index, (pan, flex) in enumerate(directions):
    robot.move_joints({"arm_shoulder_pan": pan, "arm_wrist_flex": flex}, speed=0.25)
    wait(pause_s)
    progress((index + 1) / len(directions))
robot.home(speed=0.3)
