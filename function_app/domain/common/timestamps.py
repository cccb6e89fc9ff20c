"""Timestamps as text."""

from datetime import UTC, datetime

LAST_MS = 9_999_999_999_999
"""Latest accepted time, in the year 2286 [ms since 1970]: thirteen digits sort as text."""
NEVER_MS = 2**53
"""Expiry time that means "does not expire" [ms since 1970]."""

CLOCK_SKEW_MS = 60_000
"""Highest difference between clocks of the cloud's processes [ms].

A time that is further ahead than it was when it was written shows that the clock was set back.
"""


def rfc3339(at_ms: int) -> str:
    """Milliseconds since 1970 as ``2026-01-31T12:00:00.123Z``."""
    seconds = datetime.fromtimestamp(at_ms // 1000, UTC).isoformat()[:19]
    return f"{seconds}.{at_ms % 1000:03d}Z"
