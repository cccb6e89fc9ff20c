"""What devices say, on its way into the tables, where a worker of ours subscribes to it (elsewhere the cloud calls)."""

from collections.abc import Awaitable, Callable, Sequence
from typing import Protocol

Handler = Callable[[str, bytes], Awaitable[None]]
"""Given topic and payload. Returns once it is stored: only then is the message confirmed to the broker."""


class DeviceFeed(Protocol):
    """A subscription of the functions' own."""

    async def run(self, handler: Handler) -> None:
        """Deliver until cancelled; reconnects for ever. Messages of one topic arrive in order, one at a time.

        A handler that raises ``StoreError`` or ``Problem`` is given its message again a few times; what still cannot be
        stored then, or fails in another way, is logged and let go, so that the others go on.
        """


BatchHandler = Callable[[Sequence[tuple[str, bytes]]], Awaitable[None]]
"""Given topics and payloads of what arrived in a short while."""


class TelemetryFeed(Protocol):
    """A subscription to measurements: many, each of little worth, and never in the way of the others."""

    async def run(self, handler: BatchHandler) -> None:
        """Deliver until cancelled, about every two seconds; reconnects for ever. What cannot be kept is dropped."""
