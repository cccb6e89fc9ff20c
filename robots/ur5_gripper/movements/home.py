"""Go to the home pose: elbow up, flange down over the table."""

PARAMETERS = {
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 1,
        "default": 0.4,
        "description": "Share of the joints' velocity limits",
    }
}

robot.home(speed=float(parameters.get("speed", 0.4)))
print("at home")
