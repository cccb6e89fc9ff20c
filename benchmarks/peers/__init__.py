"""Comparable protocols with the same task: one setpoint to a simulated UR5 until telemetry reports it as applied.

``arm`` is the common robot, ``robots`` serves it over each protocol in its own process, ``bridge`` is the server of the
rosbridge protocol, and ``operators`` contains the clients.
"""
