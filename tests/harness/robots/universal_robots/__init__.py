"""Emulator of a Universal Robots controller, from the published protocols. The manufacturer's is URSim."""
