"""What is addressed to agents that a program speaks for, as it passes on the broker: quick, not sure."""

from collections.abc import Callable, Sequence
from typing import Protocol

OnMessage = Callable[[str, bytes], None]
"""Given topic and payload; must not block."""


class CommandFeed(Protocol):
    """Commands, Stop and setpoints to chosen agents. What is missed here is in the mailbox, setpoints excepted."""

    @property
    def up(self) -> bool:
        """Whether they are heard now."""

    async def run(self, hear: OnMessage) -> None:
        """Deliver until cancelled; reconnects for ever."""

    async def add(self, space: str, agent: str, listen: Sequence[str] = ()) -> None:
        """OnMessage what is for this agent too, and the topics that it listens to, instead of those before."""

    def drop(self, space: str, agent: str) -> None:
        """OnMessage it no longer."""
