"""Look along the table from one side to the other, nod at each stop, and go home."""

PARAMETERS = {
    "stops": {"type": "integer", "minimum": 2, "maximum": 9, "default": 3, "description": "Number of stops"},
    "pause_s": {
        "type": "number",
        "minimum": 0,
        "maximum": 10,
        "default": 0.5,
        "unit": "s",
        "description": "Pause at each stop",
    },
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 1,
        "default": 0.4,
        "description": "Share of the joints' velocity limits",
    },
}

SIDE_RAD = 0.9

stops = min(9, max(2, int(parameters.get("stops", 3))))
pause_s = min(10.0, max(0.0, float(parameters.get("pause_s", 0.5))))
speed = float(parameters.get("speed", 0.4))

robot.home(speed=speed)
for stop in range(stops):
    pan = -SIDE_RAD + 2 * SIDE_RAD * stop / (stops - 1)
    robot.move_joints({"shoulder_pan": pan, "shoulder_lift": -1.35, "elbow": 1.45, "wrist_1": -1.67}, speed=speed)
    robot.move_joints({"wrist_1": -1.25}, speed=speed)
    robot.move_joints({"wrist_1": -1.67}, speed=speed)
    wait(pause_s)
    print("looked at", round(robot.state()["position_rad"]["shoulder_pan"], 2), "rad")
robot.home(speed=speed)
