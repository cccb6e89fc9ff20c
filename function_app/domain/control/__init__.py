"""Leases, control requests and control events."""
