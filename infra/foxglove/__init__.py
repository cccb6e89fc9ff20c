"""Endpoint for Foxglove: live data of an account's devices over Foxglove's WebSocket protocol."""
