"""Adapters for one machine or one site: SQLite, files, and a local broker."""
