"""Implementations of the ports: the same file names in each family of stores and brokers."""
