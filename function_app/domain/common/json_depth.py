"""Maximum nesting of free-form JSON, so that every program can read and write it."""

from typing import Any

MAX_LEVELS = 64
"""Maximum depth: more than parameters and results need, less than the stack of any program."""


def too_deep(value: Any, levels: int = MAX_LEVELS) -> bool:
    """Whether lists and objects are nested more than ``levels`` deep."""
    if not isinstance(value, list | tuple | dict):
        return False
    if levels == 0:
        return True
    parts = value.values() if isinstance(value, dict) else value
    return any(too_deep(part, levels - 1) for part in parts)
