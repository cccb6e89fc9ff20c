"""Diagnosis of measurements and fault records."""
