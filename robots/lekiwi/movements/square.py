"""Drive along a square without turning: forward, to the left, back, to the right."""

PARAMETERS = {
    "side_m": {
        "type": "number",
        "minimum": 0.1,
        "maximum": 1,
        "default": 0.3,
        "unit": "m",
        "description": "Side of the square",
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

side_m = min(1.0, max(0.1, float(parameters.get("side_m", 0.3))))
speed_m_s = min(0.2, max(0.05, float(parameters.get("speed_m_s", 0.15))))

robot.home(speed=0.3)
for side, (forward, left) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
    robot.drive(forward_m_s=forward * speed_m_s, left_m_s=left * speed_m_s, duration_s=side_m / speed_m_s)
    progress((side + 1) / 4)
