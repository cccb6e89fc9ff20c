"""Publishes commands to devices through MQTT (paho), AWS ``iot-data`` or Event Grid.

Delivery is not guaranteed: a message may be lost after ``publish`` returned and may arrive twice. The device drops
duplicates by id, and a timer republishes unanswered commands.
"""

from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager
from typing import Protocol

from device_agent.protocol import Ack


class BusUnavailable(Exception):  # noqa: N818 (an outcome that callers expect)
    """The broker is not reachable or did not confirm in time; the message may have been sent."""


class CommandBus(Protocol):
    """Publishes to devices and, if supported, receives their acks. Connects at first use.

    Publishing is atomic for each message and safe to retry. Without a connection, ``publish`` raises
    ``BusUnavailable``; the connection is retried in the background.

    Example::

        async with bus.acks(topic, command.id) as acks:
            await bus.publish(f"{topic}/cmd", payload)
    """

    async def start(self) -> None:
        """Connect now. Never raises: an unreachable broker is retried."""

    async def publish(self, topic: str, payload: bytes, *, qos: int = 1, retain: bool = False) -> None:
        """Publish a message; returns when the broker confirmed it (QoS 1) or the bytes were sent (QoS 0).

        A payload has at most 128 KB, 64 KB if the broker retains it; ``qos`` is 0 or 1.

        Raises:
            BusUnavailable: Not confirmed within a few seconds.
        """

    def acks(self, device_topic: str, command: str) -> AbstractAsyncContextManager[AsyncIterator[Ack] | None]:
        """Acks of one command from now on, in order of arrival.

        Enter the context before publishing the command. Waiting for the next ack may be cancelled and resumed. Yields
        ``None`` if the bus can only publish or is not connected: then read the acks from the tables.
        """

    async def status(self) -> str:
        """``ok``, or one sentence that describes the problem."""

    async def close(self) -> None:
        """Disconnect."""
