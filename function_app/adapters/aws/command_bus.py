"""Commands through AWS IoT Core, which publishes what it is given over HTTPS. Acks come by an IoT rule."""

import asyncio
import contextlib
from collections.abc import AsyncGenerator, AsyncIterator

from device_agent.protocol import Ack
from function_app.adapters.aws.client import Client, Refused
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.tables import StoreError

GIVE_UP_S = 8.0
"""Maximum time that a caller waits, including the SDK's retries."""


class IotCommandBus:
    """``CommandBus`` over ``iot-data``. Connects at the first message."""

    def __init__(self, *, region: str, endpoint: str) -> None:
        """Remember the place.

        Args:
            region: Amazon's region.
            endpoint: The account's address for data (``aws iot describe-endpoint --endpoint-type iot:Data-ATS``).
        """
        self._client = Client(
            "iot-data",
            what="AWS IoT Core",
            setting="TELESCOPE_IOT_ENDPOINT",
            how="aws iot describe-endpoint --endpoint-type iot:Data-ATS",
            region=region,
            endpoint=endpoint,
            address="TELESCOPE_IOT_ENDPOINT",
        )
        self._trouble = ""

    async def start(self) -> None:
        """See ``CommandBus``. There is no connection to make before the first message."""

    async def publish(self, topic: str, payload: bytes, *, qos: int = 1, retain: bool = False) -> None:
        """See ``CommandBus``."""
        try:
            async with asyncio.timeout(GIVE_UP_S):
                await self._client.call("publish", topic=topic, qos=qos, retain=retain, payload=payload)
        except TimeoutError as error:
            self._trouble = f"AWS IoT Core did not answer in {GIVE_UP_S:.0f} s"
            raise BusUnavailable(self._trouble) from error
        except (Refused, StoreError) as error:
            said = self._client.unusable(error) if isinstance(error, Refused) else error
            self._trouble = str(said).rstrip(".")
            raise BusUnavailable(self._trouble) from error
        self._trouble = ""

    @contextlib.asynccontextmanager
    async def acks(self, device_topic: str, command: str) -> AsyncGenerator[AsyncIterator[Ack] | None]:  # noqa: ARG002
        """See ``CommandBus``: this one only publishes."""
        yield None

    async def status(self) -> str:
        """See ``CommandBus``: how the last message fared. Nothing can be asked without publishing."""
        return self._trouble or "ok"

    async def close(self) -> None:
        """See ``CommandBus``."""
        await self._client.close()
