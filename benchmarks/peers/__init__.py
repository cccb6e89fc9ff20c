"""The peers' wires at the same work: one setpoint to a simulated UR5, until telemetry says that it is applied.

``arm`` is the robot that all of them have, ``robots`` puts it behind each wire in a process of its own, ``bridge`` is
what stands between both ends at the rosbridge-style one, and ``operators`` ask.
"""
