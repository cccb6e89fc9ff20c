"""Leases, control requests, control events and broker credentials."""
