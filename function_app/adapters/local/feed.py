"""What devices say, by MQTT subscription, confirmed by hand after it is stored."""

import asyncio
import logging
from collections.abc import Callable

from paho.mqtt.client import MQTTMessage

from device_agent.protocol import topics
from device_agent.protocol.topics import ANY
from function_app.adapters.local.mqtt_link import MqttLink
from function_app.ports.broker_access import ServiceCredentials
from function_app.ports.feed import Handler

MAX_WAITING = 10_000
"""Messages read and not yet stored. More means that the store has stopped: then the oldest unconfirmed are let go."""

FILTERS = (
    topics.conn(ANY, ANY),
    *(topics.device(ANY, ANY, ANY, kind) for kind in (topics.DESC, topics.STATE, topics.EVENT, topics.ACK)),
)
_log = logging.getLogger(__name__)


class MqttFeed:
    """``Feed`` over MQTT: one connection, one message at a time, so that every topic keeps its order."""

    def __init__(self, *, host: str, port: int, credentials: Callable[[], ServiceCredentials]) -> None:
        self._waiting: asyncio.Queue[tuple[int, MQTTMessage]] = asyncio.Queue(MAX_WAITING)
        self._link = MqttLink(
            host=host,
            port=port,
            credentials=credentials,
            subscriptions=FILTERS,
            receive=self._arrived,
            manual_ack=True,
        )

    async def run(self, handler: Handler) -> None:
        """See ``Feed``."""
        self._link.start()
        try:
            while True:
                generation, message = await self._waiting.get()
                try:
                    await handler(message.topic, bytes(message.payload))
                except Exception:  # noqa: BLE001 (unconfirmed, it comes again where the broker can)
                    _log.exception("ingest of %s failed", message.topic)
                else:
                    self._link.acknowledge(message, generation)
        finally:
            await self._link.close()

    def _arrived(self, message: MQTTMessage) -> None:
        if self._waiting.full():
            _, dropped = self._waiting.get_nowait()
            _log.warning("ingest is behind: a message of %s was not stored", dropped.topic)
        self._waiting.put_nowait((self._link.generation, message))
