"""One line of a report."""

from typing import Literal

from msgspec import Struct


class Finding(Struct, frozen=True):
    """What was looked at, how it is, what that means, and what to do about it where it is not well."""

    check: str
    level: Literal["ok", "warning", "problem"]
    message: str
    advice: str = ""


def ok(check: str, message: str) -> Finding:
    """All is well."""
    return Finding(check, "ok", message)


def warning(check: str, message: str, advice: str) -> Finding:
    """The agent runs, but not with all that it could."""
    return Finding(check, "warning", message, advice)


def problem(check: str, message: str, advice: str) -> Finding:
    """The agent cannot do its work."""
    return Finding(check, "problem", message, advice)
