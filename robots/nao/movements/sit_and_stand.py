"""Sit down on a stool (or squat without one), rest, and stand up again."""

PARAMETERS = {
    "rest_s": {
        "type": "number",
        "minimum": 0,
        "maximum": 60,
        "default": 2,
        "unit": "s",
        "description": "How long to sit",
    }
}

rest_s = min(60.0, max(0.0, float(parameters.get("rest_s", 2))))

robot.posture("StandInit", speed=0.3)
robot.posture("Sit", speed=0.3)
progress(0.4)
robot.posture("SitRelax", speed=0.1)
wait(rest_s)
robot.posture("Sit", speed=0.1)
progress(0.8)
robot.posture("StandInit", speed=0.3)
