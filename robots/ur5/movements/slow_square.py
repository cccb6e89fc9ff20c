"""Draw a level square in the air with the flange pointing down, slowly, and go home."""

import math
from itertools import pairwise

PARAMETERS = {
    "side_m": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 0.25,
        "default": 0.2,
        "unit": "m",
        "description": "Side of the square",
    },
    "height_m": {
        "type": "number",
        "minimum": 0.15,
        "maximum": 0.4,
        "default": 0.25,
        "unit": "m",
        "description": "Height of the flange above the table",
    },
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 1,
        "default": 0.15,
        "description": "Share of the joints' velocity limits",
    },
}

# Dimensions of the arm [m]: robots/ur5/README.md.
SHOULDER_HEIGHT, UPPER_ARM, FOREARM = 0.089159, 0.425, 0.39225
LATERAL, WRIST_2, FLANGE = 0.10915, 0.09465, 0.0823
CENTRE_X, CENTRE_Y = -0.45, 0.0
POINTS_PER_SIDE = 8


def flange_down(x, y, z):
    """Joint positions [rad] that put the flange at a point [m], pointing down, elbow up."""
    reach = math.sqrt(x * x + y * y - LATERAL * LATERAL)
    pan = math.remainder(math.atan2(y, x) - math.atan2(-LATERAL, -reach), 2 * math.pi)
    along, up = reach - WRIST_2, z + FLANGE - SHOULDER_HEIGHT
    elbow = math.acos((along * along + up * up - UPPER_ARM**2 - FOREARM**2) / (2 * UPPER_ARM * FOREARM))
    bend = math.atan2(FOREARM * math.sin(elbow), UPPER_ARM + FOREARM * math.cos(elbow))
    lift = -math.atan2(up, along) - bend
    return [pan, lift, elbow, -math.pi / 2 - lift - elbow, -math.pi / 2, pan]


side_m = min(0.25, max(0.05, float(parameters.get("side_m", 0.2))))
height_m = min(0.4, max(0.15, float(parameters.get("height_m", 0.25))))
speed = float(parameters.get("speed", 0.15))

corners = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5)]
robot.home(speed=0.4)
robot.move_joints(flange_down(CENTRE_X - side_m / 2, CENTRE_Y - side_m / 2, height_m), speed=0.3)
for (x0, y0), (x1, y1) in pairwise(corners):
    for point in range(1, POINTS_PER_SIDE + 1):
        share = point / POINTS_PER_SIDE
        x = CENTRE_X + side_m * (x0 + (x1 - x0) * share)
        y = CENTRE_Y + side_m * (y0 + (y1 - y0) * share)
        robot.move_joints(flange_down(x, y, height_m), speed=speed)
    print("side done")
robot.home(speed=0.4)
