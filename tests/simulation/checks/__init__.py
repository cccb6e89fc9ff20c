"""The history of a simulation and the checks on it."""
