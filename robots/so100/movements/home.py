"""Go to the home pose: upper arm upright, forearm and gripper forward."""

PARAMETERS = {
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 1,
        "default": 0.3,
        "description": "Share of the joints' velocity limits",
    }
}

robot.home(speed=float(parameters.get("speed", 0.3)))
print("at home")
