"""Errors of the agent's configuration."""


class ConfigError(Exception):
    """The agent's folder or configuration cannot be used. The message names the file and the remedy."""
