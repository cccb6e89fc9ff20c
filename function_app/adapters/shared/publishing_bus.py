"""A command bus that publishes over HTTPS. Acks arrive at the ingest."""

import asyncio
import contextlib
from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, AsyncIterator

from device_agent.protocol import Ack
from function_app.ports.command_bus import BusUnavailable

GIVE_UP_S = 8.0
"""Maximum time that a caller waits, including retries."""


class PublishingBus(ABC):
    """``CommandBus`` of the broker ``name``. Connects at the first message."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._problem = ""

    async def start(self) -> None:  # noqa: B027 (nothing to override)
        """Does nothing: the bus connects at the first message."""

    async def publish(self, topic: str, payload: bytes, *, qos: int = 1, retain: bool = False) -> None:
        try:
            async with asyncio.timeout(GIVE_UP_S):
                await self._publish(topic, payload, qos, retain)
        except TimeoutError as error:
            self._problem = f"{self._name} did not answer in {GIVE_UP_S:.0f} s"
            raise BusUnavailable(self._problem) from error
        except BusUnavailable as error:
            self._problem = str(error)
            raise
        self._problem = ""

    @contextlib.asynccontextmanager
    async def acks(self, device_topic: str, command: str) -> AsyncGenerator[AsyncIterator[Ack] | None]:  # noqa: ARG002
        yield None

    async def status(self) -> str:
        """The result of the last message."""
        return self._problem or "ok"

    @abstractmethod
    async def _publish(self, topic: str, payload: bytes, qos: int, retain: bool) -> None:
        """Send one message.

        Raises:
            BusUnavailable: The broker does not accept it.
        """
