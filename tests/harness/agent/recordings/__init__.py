"""Recorded agents and devices, and recordings for tests."""
