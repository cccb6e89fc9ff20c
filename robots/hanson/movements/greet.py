"""Greet: raise the brows, smile, and bow the head a little to one side."""

PARAMETERS = {
    "strength": {"type": "number", "minimum": 0, "maximum": 1, "default": 1, "description": "Strength of the smile"}
}

SMILE_RAD = {
    "Smile-L": 1.1,
    "Smile-R": 1.1,
    "EE-oo-L": 0.5,
    "EE-oo-R": 0.5,
    "Cheek-Squint-L": 0.14,
    "Cheek-Squint-R": 0.14,
}
BROWS_RAD = {"Brow-Inner-L": 0.2, "Brow-Inner-R": 0.2, "Brow-Outer-L": 0.2, "Brow-Outer-R": 0.2}
BOW_RAD = {"Upper-Gimbal-L": 1.0, "Upper-Gimbal-R": -0.4}

strength = min(1.0, max(0.0, float(parameters.get("strength", 1))))

robot.move_joints(BROWS_RAD, speed=0.3)
robot.move_joints({name: strength * place for name, place in SMILE_RAD.items()}, speed=0.3)
robot.move_joints(BOW_RAD, speed=0.4)
wait(1.0)
robot.home(speed=0.3)
