"""Rules that decide who may move a device: leases, Stop, faults, interlocks, reservations."""
