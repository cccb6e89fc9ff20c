"""Recordings of sessions: what the robot measured, was requested to do, and did, in each control period."""
