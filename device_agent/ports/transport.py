"""Port: message transport between agent and cloud. The implementer's manual.

All transports carry the same topics and payloads. Safety never depends on a transport: it may lose, duplicate, delay
and reorder messages.
"""

from collections.abc import Callable
from typing import Protocol

Receive = Callable[[str, bytes], None]
"""Called with topic and payload for each message that arrives, on the transport's own thread; must not block."""
LinkChanged = Callable[[bool], None]
"""Called with True when the link is up (subscriptions made, presence published) and False when it is lost."""


class TransportError(Exception):
    """The transport cannot start. The message names what to check."""


class Transport(Protocol):
    """The link of one agent. The constructor opens no connection."""

    def start(self, receive: Receive, link_changed: LinkChanged) -> None:
        """Connect, and reconnect indefinitely with jittered backoff. Returns immediately.

        Raises:
            TransportError: The configuration is unusable.
        """

    def publish(
        self, topic: str, payload: bytes, *, qos: int, retain: bool = False, delivered: Callable[[], None] | None = None
    ) -> bool:
        """Send a message. Thread-safe; never blocks.

        Args:
            topic: Topic of ``protocol.topics``.
            payload: The encoded message.
            qos: 0 or 1.
            retain: Whether the broker retains it for later subscribers.
            delivered: With ``qos`` 1, called once the cloud has stored the message or rejects it permanently; never if
                that is unknown. Over MQTT, the broker's acknowledgement counts for state, description and presence,
                and for servers that do not confirm storage. The caller repeats messages that must not be lost.

        Returns:
            False if the message was dropped: the link is down, its queue is full, or a frame of the same camera is
            still queued. Measurements are dropped on purpose; the caller stores messages that must not be lost.
        """

    def stop(self) -> None:
        """Publish the offline presence and disconnect within a second. May be called repeatedly."""
