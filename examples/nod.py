"""Nod with the last wrist joint, a few times.

A movement script for the UR5. Store it in the console under *Movements*, or with
``PUT /robot-types/ur5/movements/nod`` and the body ``{"source": "…"}``.
"""

PARAMETERS = {"times": {"type": "integer", "minimum": 1, "maximum": 5, "default": 2, "description": "How often"}}

times = parameters.get("times", 2)
for count in range(times):
    robot.move_joints({"wrist_3": 0.3}, speed=0.6)
    robot.move_joints({"wrist_3": -0.3}, speed=0.6)
    progress((count + 1) / times)
robot.move_joints({"wrist_3": 0.0}, speed=0.6)
