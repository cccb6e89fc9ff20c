"""Periodic jobs and the readiness check."""
