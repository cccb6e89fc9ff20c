"""Show the basic emotions one by one, and name them if speech is available."""

PARAMETERS = {
    "strength": {
        "type": "number",
        "minimum": 0.1,
        "maximum": 1,
        "default": 1,
        "description": "Strength of each expression",
    },
    "hold_s": {
        "type": "number",
        "minimum": 0,
        "maximum": 10,
        "default": 1.0,
        "unit": "s",
        "description": "Duration of each expression",
    },
}

EMOTIONS = ("happy", "surprised", "afraid", "angry", "disgusted", "sad")

strength = min(1.0, max(0.1, float(parameters.get("strength", 1))))
hold_s = min(10.0, max(0.0, float(parameters.get("hold_s", 1.0))))

for count, name in enumerate(EMOTIONS, 1):
    robot.express(name, strength=strength)
    if "say" in robot.can:
        robot.say(name)
    wait(hold_s)
    progress(count / len(EMOTIONS))
robot.express("neutral")
