"""Fault detectors, diagnosis and fault records."""
