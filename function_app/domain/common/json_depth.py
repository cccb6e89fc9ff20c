"""How deep free-form JSON may be: what one program can read, every other must be able to write and read again."""

from typing import Any

MAX_LEVELS = 64
"""Far more than parameters or results need, far less than any program's stack."""


def too_deep(value: Any, levels: int = MAX_LEVELS) -> bool:
    """Whether lists and objects are nested in one another more than ``levels`` times."""
    if not isinstance(value, list | tuple | dict):
        return False
    if levels == 0:
        return True
    parts = value.values() if isinstance(value, dict) else value
    return any(too_deep(part, levels - 1) for part in parts)
