"""Come forward until the sonars hear something near, look up, and go back a little."""

PARAMETERS = {
    "near_m": {
        "type": "number",
        "minimum": 0.15,
        "maximum": 2,
        "default": 0.5,
        "unit": "m",
        "description": "How near is near",
    },
    "farthest_m": {
        "type": "number",
        "minimum": 0.1,
        "maximum": 3,
        "default": 1.5,
        "unit": "m",
        "description": "It comes no farther than this",
    },
    "speed_m_s": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 0.2,
        "default": 0.15,
        "unit": "m/s",
        "description": "How fast",
    },
}

STEP_S = 0.4

near_m = min(2.0, max(0.15, float(parameters.get("near_m", 0.5))))
farthest_m = min(3.0, max(0.1, float(parameters.get("farthest_m", 1.5))))
speed_m_s = min(0.2, max(0.05, float(parameters.get("speed_m_s", 0.15))))


def heard():
    """The nearer of what both sonars hear [m]."""
    sonar = robot.state()["streams"].get("sonar")
    if sonar is None or sonar["age_s"] > 1.0:
        raise RobotError("the sonars tell nothing; it stays where it is")
    return min(sonar["values"]["distance_m.left"], sonar["values"]["distance_m.right"])


gone_m = 0.0
while heard() > near_m and gone_m < farthest_m:
    robot.drive(forward_m_s=speed_m_s, duration_s=STEP_S)
    gone_m += speed_m_s * STEP_S
    progress(min(1.0, gone_m / farthest_m))
print("stands", round(heard(), 2), "m before what it hears" if gone_m < farthest_m else "m from anything")
robot.look([0.8, 0.0, 0.75], speed=0.4)
wait(0.5)
robot.home(speed=0.4)
robot.drive(forward_m_s=-0.1, duration_s=1.0)
