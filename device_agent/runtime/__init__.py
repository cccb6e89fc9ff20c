"""What every device gets from the agent: control loop, lease, watchdog, actions, movements, journal."""
