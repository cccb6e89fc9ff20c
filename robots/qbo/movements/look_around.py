"""Look to both sides, up, down, and ahead."""

PARAMETERS = {
    "times": {"type": "integer", "minimum": 1, "maximum": 10, "default": 1, "description": "Repetitions"},
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 1,
        "default": 0.4,
        "description": "Share of the joints' velocity limits",
    },
}

times = min(10, max(1, int(parameters.get("times", 1))))
speed = float(parameters.get("speed", 0.4))

for count in range(times):
    for pan, tilt in ((0.9, -0.1), (0.9, -0.5), (-0.9, -0.5), (-0.9, 0.2), (0.0, 0.25)):
        robot.move_joints({"head_pan": pan, "head_tilt": tilt}, speed=speed)
        wait(0.4)
    progress((count + 1) / times)
robot.home(speed=speed)
