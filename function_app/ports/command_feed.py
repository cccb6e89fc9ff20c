"""Commands for agents that another program represents, as published on the broker. Best effort."""

from collections.abc import Callable, Sequence
from typing import Protocol

OnMessage = Callable[[str, bytes], None]
"""Called with topic and payload; must not block."""


class CommandFeed(Protocol):
    """Receives commands, Stop and setpoints for chosen agents.

    Messages may be lost while disconnected. Missed commands remain in the mailbox; missed setpoints are lost. ``add``
    and ``drop`` are idempotent.

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
