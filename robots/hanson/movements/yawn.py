"""Yawn: open the mouth, close the eyes, lean the head back, and return home."""

PARAMETERS = {
    "speed": {
        "type": "number",
        "minimum": 0.02,
        "maximum": 0.5,
        "default": 0.12,
        "description": "Share of the joints' velocity limits",
    },
    "hold_s": {
        "type": "number",
        "minimum": 0,
        "maximum": 10,
        "default": 1.0,
        "unit": "s",
        "description": "Duration with open mouth",
    },
}

WIDE_RAD = {
    "Jaw": 1.5,
    "EE-oo-L": -0.5,
    "EE-oo-R": -0.5,
    "Eyelid-Upper-L": -0.8,
    "Eyelid-Upper-R": -0.8,
    "Eyelid-Lower-L": 0.2,
    "Eyelid-Lower-R": 0.2,
    "Brow-Inner-L": 0.2,
    "Brow-Inner-R": 0.2,
    "Cheek-Squint-L": 0.12,
    "Cheek-Squint-R": 0.12,
    "Upper-Gimbal-L": -0.6,
    "Upper-Gimbal-R": 0.6,
}

speed = min(0.5, max(0.02, float(parameters.get("speed", 0.12))))
hold_s = min(10.0, max(0.0, float(parameters.get("hold_s", 1.0))))

robot.move_joints(WIDE_RAD, speed=speed)
wait(hold_s)
robot.home(speed=speed)
