"""Blink, sometimes with one eye only."""

PARAMETERS = {
    "times": {"type": "integer", "minimum": 1, "maximum": 50, "default": 4, "description": "How often to blink"},
    "wink_every": {
        "type": "integer",
        "minimum": 0,
        "maximum": 50,
        "default": 4,
        "description": "Interval of blinks with the left eye only; 0: never",
    },
    "pause_s": {
        "type": "number",
        "minimum": 0,
        "maximum": 20,
        "default": 1.5,
        "unit": "s",
        "description": "Pause between blinks",
    },
}

CLOSED_RAD, OPEN_RAD = -0.9, 0.0

times = min(50, max(1, int(parameters.get("times", 4))))
wink_every = max(0, int(parameters.get("wink_every", 4)))
pause_s = min(20.0, max(0.0, float(parameters.get("pause_s", 1.5))))

for count in range(1, times + 1):
    wink = wink_every > 0 and count % wink_every == 0
    lids = ["Eyelid-Upper-L"] if wink else ["Eyelid-Upper-L", "Eyelid-Upper-R"]
    robot.move_joints(dict.fromkeys(lids, CLOSED_RAD), speed=1.0)
    robot.move_joints(dict.fromkeys(lids, OPEN_RAD), speed=1.0)
    progress(count / times)
    if count < times:
        wait(pause_s)
