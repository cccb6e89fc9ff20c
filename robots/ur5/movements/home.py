"""Go to the home pose: elbow up, flange down over the table.

Parameters: speed (share of the joints' velocity limits, default 0.4).
"""

robot.home(speed=float(parameters.get("speed", 0.4)))
print("at home")
