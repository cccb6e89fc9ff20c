"""Publication of telemetry, state, events and camera frames."""
