"""Metrics and storage use of the local server."""
