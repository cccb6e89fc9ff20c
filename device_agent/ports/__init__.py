"""Ports: interfaces of drivers, sensors, transports and services."""
