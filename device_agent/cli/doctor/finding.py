"""One line of the report."""

from typing import Literal

from msgspec import Struct


class Finding(Struct, frozen=True):
    """What was checked, its level, the result, and the remedy for a problem."""

    check: str
    level: Literal["ok", "warning", "problem"]
    message: str
    advice: str = ""


def ok(check: str, message: str) -> Finding:
    """The check passed."""
    return Finding(check, "ok", message)


def warning(check: str, message: str, advice: str) -> Finding:
    """The agent runs, but with reduced functions."""
    return Finding(check, "warning", message, advice)


def problem(check: str, message: str, advice: str) -> Finding:
    """The agent cannot work."""
    return Finding(check, "problem", message, advice)
