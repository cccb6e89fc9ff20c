"""Runtime of an agent's devices: control loop, leases, commands, actions, telemetry, journal."""
