"""Move between the two trays as with a gripper: over, down, up, across."""

PARAMETERS = {
    "times": {"type": "integer", "minimum": 1, "maximum": 20, "default": 2, "description": "Repetitions"},
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 1,
        "default": 0.5,
        "description": "Share of the joints' velocity limits",
    },
}

# Positions over the trays of scene.xml, flange down, 200 mm and 60 mm above the table [rad].
OVER = {
    "orange": [0.267, -1.274, 1.849, -2.146, -1.571, 0.267],
    "green": [-0.660, -1.274, 1.849, -2.146, -1.571, -0.660],
}
DOWN = {
    "orange": [0.267, -1.036, 1.958, -2.493, -1.571, 0.267],
    "green": [-0.660, -1.036, 1.958, -2.493, -1.571, -0.660],
}

times = min(20, max(1, int(parameters.get("times", 2))))
speed = float(parameters.get("speed", 0.5))


def visit(tray):
    """Move down to a tray and up again, slowly near it."""
    robot.move_joints(OVER[tray], speed=speed)
    robot.move_joints(DOWN[tray], speed=speed / 2)
    wait(0.3)
    robot.move_joints(OVER[tray], speed=speed / 2)


robot.home(speed=speed)
for count in range(times):
    visit("orange")
    visit("green")
    progress((count + 1) / times)
    print("carried", count + 1, "of", times)
robot.home(speed=speed)
