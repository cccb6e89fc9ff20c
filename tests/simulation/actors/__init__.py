"""The simulated machines and people."""
