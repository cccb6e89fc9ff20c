"""Brokers, servers and packaging around the code; each is a separate program."""
