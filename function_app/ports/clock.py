"""The wall clock."""

from typing import Protocol


class Clock(Protocol):
    """Wall clock. Never blocks.

    Example::

        expires_ms = clock.now_ms() + 5_000
    """

    def now_ms(self) -> int:
        """Current time [ms since 1970, UTC]."""
