"""Broker auth."""
