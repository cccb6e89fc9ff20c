"""Time as text."""

from datetime import UTC, datetime


def rfc3339(at_ms: int) -> str:
    """Milliseconds since 1970 as ``2026-01-31T12:00:00.123Z``."""
    moment = datetime.fromtimestamp(at_ms // 1000, UTC)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{at_ms % 1000:03d}Z"
