"""Look around: the eyes move first, the neck follows, and the eyes return to the centre."""

PARAMETERS = {
    "rounds": {"type": "integer", "minimum": 1, "maximum": 10, "default": 1, "description": "Repetitions"},
    "pause_s": {
        "type": "number",
        "minimum": 0,
        "maximum": 10,
        "default": 0.4,
        "unit": "s",
        "description": "Pause at each position",
    },
}

PLACES_RAD = ((0.7, 0.15), (0.2, -0.2), (-0.7, 0.1), (0.0, 0.0))  # left, up

rounds = min(10, max(1, int(parameters.get("rounds", 1))))
pause_s = min(10.0, max(0.0, float(parameters.get("pause_s", 0.4))))

for count in range(rounds):
    for left, up in PLACES_RAD:
        first = max(-0.5, min(0.5, left - robot.state()["position_rad"]["Neck-Rotation"]))
        robot.move_joints({"EyeTurn-L": first, "EyeTurn-R": first, "Eyes-Up-Down": up}, speed=0.9)
        robot.move_joints({"Neck-Rotation": left, "EyeTurn-L": 0.0, "EyeTurn-R": 0.0}, speed=0.4)
        wait(pause_s)
    progress((count + 1) / rounds)
robot.home(speed=0.4)
