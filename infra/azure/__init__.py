"""Telescope at Azure: what the Event Grid namespace is told that agents and pages connect to."""
