"""Manifests of robot types (``robot.toml``) and rooms (``room.toml``)."""
