"""Messages of devices, from a broker subscription of a worker. Cloud brokers call the ingest instead."""

from collections.abc import Awaitable, Callable, Sequence
from typing import Protocol

Handler = Callable[[str, bytes], Awaitable[None]]
"""Called with topic and payload. Returns when the message is stored; only then is it acknowledged to the broker."""


class DeviceFeed(Protocol):
    """A subscription of the functions to state and events of devices.

    At-least-once: a message may be delivered twice, so the handler must be idempotent. While disconnected, the broker
    queues messages within its limits.

    Example::

        await feed.run(handler)
    """

    async def run(self, handler: Handler) -> None:
        """Deliver until cancelled; reconnects without limit. Messages of one topic arrive in order, one at a time.

        If the handler raises ``StoreError`` or ``Problem``, the message is retried a few times. Messages that still
        fail are logged and dropped.
        """


BatchHandler = Callable[[Sequence[tuple[str, bytes]]], Awaitable[None]]
"""Called with topics and payloads of a short time window."""


class TelemetryFeed(Protocol):
    """A best-effort subscription to telemetry, separate from other messages.

    Example::

        await feed.run(batch_handler)
    """

    async def run(self, handler: BatchHandler) -> None:
        """Deliver batches about every two seconds until cancelled; reconnects. Drops messages on overload."""
