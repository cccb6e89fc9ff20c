"""The folder of an installation: its lock, and archives of its content."""
