"""What carries messages between the agent and the cloud. This page is the implementer's manual.

All transports carry the same topics and the same payloads; they differ in how. Safety never rests on a transport: it
may lose, double, delay and reorder.
"""

from collections.abc import Callable
from typing import Protocol

Receive = Callable[[str, bytes], None]
"""Called with topic and payload for each message that arrives, on the transport's own thread; must not block."""
LinkChanged = Callable[[bool], None]
"""Called with True when the link is up (subscriptions made, presence published) and False when it is lost."""


class TransportError(Exception):
    """The transport cannot start. Its text says what to check."""


class Transport(Protocol):
    """One link of one agent. The constructor opens nothing."""

    def start(self, receive: Receive, link_changed: LinkChanged) -> None:
        """Connect and stay connected: reconnects by itself with jittered back-off, for ever. Returns at once.

        Raises:
            TransportError: Its configuration is unusable.
        """

    def publish(
        self,
        topic: str,
        payload: bytes,
        *,
        qos: int,
        retain: bool = False,
        delivered: Callable[[], None] | None = None,
    ) -> bool:
        """Send; thread-safe; never blocks.

        Args:
            topic: One of ``protocol.topics``.
            payload: The message, encoded.
            qos: 0 or 1.
            retain: Whether the broker keeps it for later subscribers.
            delivered: With ``qos`` 1, called once the other side has confirmed the message; never if that is unknown.

        Returns:
            False when the message was dropped: the link is down or its queue full, or a picture of the same camera
            still waits to be sent. Measurements are then lost on purpose, and the caller keeps what must not be.
        """

    def stop(self) -> None:
        """Say goodbye (presence offline), and disconnect within a second. May be called twice."""
