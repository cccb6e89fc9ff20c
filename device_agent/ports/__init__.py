"""What the agent's runtime asks of the outside: drivers, transports, clocks."""
