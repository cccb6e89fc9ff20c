"""Ports: the protocols that adapters implement. Each module is the manual for implementers."""
