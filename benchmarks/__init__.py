"""Benchmarks of Telescope, of its parts and of comparable systems."""
