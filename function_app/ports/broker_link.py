"""One connection to the broker with the permissions of a person."""

from collections.abc import Awaitable, Callable, Iterable, Sequence
from typing import Protocol

from function_app.ports.broker_access import ServiceCredentials

Credentials = Callable[[], Awaitable[ServiceCredentials]]
"""Called for each connection; raises ``BrokerAccessError`` if the person has no permission now."""
OnMessage = Callable[[str, bytes], None]
"""Called with topic and payload; must not block."""


class BrokerLink(Protocol):
    """Connects when it is created, and again with new credentials after a loss, until it is closed."""

    async def subscribe(self, patterns: Sequence[str]) -> None:
        """Add subscriptions, which the permissions must cover."""

    def unsubscribe(self, patterns: Iterable[str]) -> None:
        """Remove subscriptions."""

    async def publish(self, topic: str, payload: bytes, qos: int) -> None:
        """Publish a message.

        Raises:
            BusUnavailable: The broker cannot be reached, or the permissions have ended.
        """

    async def close(self) -> None:
        """Disconnect. May be called twice."""


OpenLink = Callable[[Credentials, OnMessage], BrokerLink]
"""Opens a connection without waiting for it."""
