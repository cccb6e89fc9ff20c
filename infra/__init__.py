"""Brokers, servers and packaging around the code; each is a program of its own."""
