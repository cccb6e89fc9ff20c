"""Broker subscriptions of long-running programs: messages of devices, telemetry, and commands for agents.

Cloud brokers call the ingest instead.
"""

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


OnMessage = Callable[[str, bytes], None]
"""Called with topic and payload; must not block."""


class CommandFeed(Protocol):
    """Receives commands, Stop and setpoints for agents that another program represents, such as the XMPP gateway.

    Best effort. Messages may be lost while disconnected. Missed commands remain in the mailbox; missed setpoints are
    lost. ``add`` and ``drop`` are idempotent.

    Example::

        await feed.add(space, agent)
        await feed.run(on_message)
    """

    @property
    def up(self) -> bool:
        """Whether the feed is connected and subscribed."""

    async def run(self, on_message: OnMessage) -> None:
        """Deliver messages until cancelled; reconnects without limit."""

    async def add(self, space: str, agent: str, listen: Sequence[str] = ()) -> None:
        """Subscribe to the messages of an agent, and to ``listen`` in place of its earlier topics."""

    def drop(self, space: str, agent: str) -> None:
        """Unsubscribe from the messages of an agent."""
