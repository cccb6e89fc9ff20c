"""Drive forward until the sonars detect an obstacle, look up, and drive back a little."""

PARAMETERS = {
    "near_m": {
        "type": "number",
        "minimum": 0.15,
        "maximum": 2,
        "default": 0.5,
        "unit": "m",
        "description": "Distance at which it stops",
    },
    "farthest_m": {
        "type": "number",
        "minimum": 0.1,
        "maximum": 3,
        "default": 1.5,
        "unit": "m",
        "description": "Maximum driving distance",
    },
    "speed_m_s": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 0.2,
        "default": 0.15,
        "unit": "m/s",
        "description": "Speed",
    },
}

STEP_S = 0.4

near_m = min(2.0, max(0.15, float(parameters.get("near_m", 0.5))))
farthest_m = min(3.0, max(0.1, float(parameters.get("farthest_m", 1.5))))
speed_m_s = min(0.2, max(0.05, float(parameters.get("speed_m_s", 0.15))))


def distance_m():
    """The smaller distance of both sonars [m]."""
    sonar = robot.state()["streams"].get("sonar")
    if sonar is None or sonar["age_s"] > 1.0:
        raise RobotError("no sonar data; the movement ends")
    return min(sonar["values"]["distance_m.left"], sonar["values"]["distance_m.right"])


driven_m = 0.0
while distance_m() > near_m and driven_m < farthest_m:
    robot.drive(forward_m_s=speed_m_s, duration_s=STEP_S)
    driven_m += speed_m_s * STEP_S
    progress(min(1.0, driven_m / farthest_m))
print(
    "stopped", round(distance_m(), 2), "m before an obstacle" if driven_m < farthest_m else "m from the next obstacle"
)
robot.look([0.8, 0.0, 0.75], speed=0.4)
wait(0.5)
robot.home(speed=0.4)
robot.drive(forward_m_s=-0.1, duration_s=1.0)
