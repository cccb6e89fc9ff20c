"""Enrolment, claiming, unpairing and offboarding of agents."""
