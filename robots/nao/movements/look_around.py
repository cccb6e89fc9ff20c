"""Look left, right, up and down."""

PARAMETERS = {
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 0.5,
        "default": 0.15,
        "description": "Share of the joints' velocity limits",
    },
    "pause_s": {
        "type": "number",
        "minimum": 0,
        "maximum": 5,
        "default": 0.5,
        "unit": "s",
        "description": "Pause in each direction",
    },
}

speed = min(0.5, max(0.05, float(parameters.get("speed", 0.15))))
pause_s = min(5.0, max(0.0, float(parameters.get("pause_s", 0.5))))

directions = [(1.0, -0.1), (0.0, -0.35), (-1.0, -0.1), (0.0, 0.3)]
robot.home(speed=0.3)
for index, (yaw, pitch) in enumerate(directions):
    robot.move_joints({"HeadYaw": yaw, "HeadPitch": pitch}, speed=speed)
    wait(pause_s)
    progress((index + 1) / len(directions))
robot.home(speed=speed)
