"""The way from the cloud to devices. paho (warm connection), ``iot-data``, Event Grid HTTP publish.

At least once at best: a message may be lost after ``publish`` returned (an offline device) and may arrive twice. The
device drops doubles by id, and a timer sends again what nobody answered.
"""

from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager
from typing import Protocol

from device_agent.protocol import Ack


class BusUnavailable(Exception):  # noqa: N818 (an outcome that callers expect)
    """The broker cannot be reached or did not confirm in time; the message may or may not have gone out."""


class CommandBus(Protocol):
    """Publishes towards devices and, where it can, hears their acks. Connects at first use and stays connected."""

    async def start(self) -> None:
        """Connect now rather than at first use. Never raises: a broker that is away is tried again."""

    async def publish(self, topic: str, payload: bytes, *, qos: int = 1, retain: bool = False) -> None:
        """Send; returns once the broker has confirmed (QoS 1) or the bytes are on their way (QoS 0).

        Args:
            topic: Where to.
            payload: At most 128 KB, 64 KB where it is retained.
            qos: 0 or 1.
            retain: Keep it for whoever subscribes later, instead of what was kept there before.

        Raises:
            BusUnavailable: Not confirmed within a few seconds.
        """

    def acks(self, device_topic: str, command: str) -> AbstractAsyncContextManager[AsyncIterator[Ack] | None]:
        """Acks of one command from now on, in order of arrival.

        A wait for the next one may be given up and begun again.

        Enter it before publishing the command. Gives ``None`` where the bus only publishes (or cannot connect): then
        the answer is to be read from the tables, where the ingest entry point writes it.
        """

    async def status(self) -> str:
        """``ok``, or a sentence about what is wrong."""

    async def close(self) -> None:
        """Disconnect."""
