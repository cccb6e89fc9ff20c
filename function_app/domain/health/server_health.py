"""State of the server's own parts: stores, broker, workers and timers."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum


class Status(StrEnum):
    """State of a part, best first."""

    OK = "ok"
    DEGRADED = "degraded"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check; ``message`` states the cause and the remedy, or a figure."""

    status: Status
    message: str


@dataclass(frozen=True, slots=True)
class Part:
    """One part of the server. ``since_ms``: when its present status began [ms since 1970]."""

    name: str
    status: Status
    message: str
    since_ms: int


def worst(parts: Iterable[Part | Finding]) -> Status:
    """The worst status; ``ok`` without parts."""
    order = list(Status)
    return max((part.status for part in parts), key=order.index, default=Status.OK)


def disk_space(free_bytes: int | None, min_free_bytes: int) -> Finding:
    """The state of a disk. A cloud store has no fixed size (``None``)."""
    if free_bytes is None:
        return Finding(Status.OK, "the cloud store has no fixed size")
    free = f"{free_bytes / 1e9:.1f} GB free" if free_bytes >= 1e9 else f"{free_bytes / 1e6:.0f} MB free"  # noqa: PLR2004
    if free_bytes < min_free_bytes / 10:
        return Finding(Status.FAILED, f"{free}: rows and keys may soon not be stored. Free disk space now.")
    if free_bytes < min_free_bytes:
        limit = f"TELESCOPE_MIN_FREE_MB is {min_free_bytes / 1e6:.0f}"
        return Finding(Status.DEGRADED, f"{free}, {limit}: captures and measurements are rejected. Free disk space.")
    return Finding(Status.OK, free)
