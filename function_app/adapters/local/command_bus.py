"""Commands and acks over one persistent MQTT connection."""

import asyncio
import contextlib
from collections.abc import AsyncGenerator, AsyncIterator

from paho.mqtt.client import MQTTMessage

from device_agent.protocol import Ack, codec, topics
from device_agent.protocol.errors import ProtocolError
from function_app.adapters.mqtt.connection import Broker, MqttConnection

_READY_S = 2.0


class MqttCommandBus:
    """``CommandBus`` over MQTT. Every instance receives all acks and uses those that a local call waits for."""

    def __init__(self, broker: Broker) -> None:
        self._connection = MqttConnection(
            broker,
            subscriptions=(topics.device(topics.ANY, topics.ANY, topics.ANY, topics.ACK),),
            receive=self._dispatch,
        )
        self._waiting: dict[str, dict[str, set[asyncio.Queue[Ack]]]] = {}

    async def start(self) -> None:
        await self._connection.ready(_READY_S)

    async def publish(self, topic: str, payload: bytes, *, qos: int = 1, retain: bool = False) -> None:
        await self._connection.publish(topic, payload, qos, retain=retain)

    @contextlib.asynccontextmanager
    async def acks(self, device_topic: str, command: str) -> AsyncGenerator[AsyncIterator[Ack] | None]:
        if not await self._connection.ready(_READY_S):
            yield None
            return
        topic = f"{device_topic}/{topics.ACK}"
        queue: asyncio.Queue[Ack] = asyncio.Queue()
        commands = self._waiting.setdefault(topic, {})
        queues = commands.setdefault(command, set())
        queues.add(queue)
        try:
            yield _Acks(queue)
        finally:
            queues.remove(queue)
            if not queues:
                del commands[command]
            if not commands:
                del self._waiting[topic]

    async def status(self) -> str:
        await self._connection.attempted(_READY_S)
        return self._connection.problem or "ok"

    async def close(self) -> None:
        await self._connection.close()

    def _dispatch(self, message: MQTTMessage) -> None:
        # By topic and id: an agent can only acknowledge for its own devices, with any id in its ack.
        waiting = self._waiting.get(message.topic)
        if waiting is None:
            return
        try:
            ack = codec.decode(bytes(message.payload), Ack)
        except ProtocolError:
            return  # the ingest worker logs it
        for queue in waiting.get(ack.id, ()):
            queue.put_nowait(ack)


class _Acks(AsyncIterator[Ack]):
    """Acks in order of arrival. Not a generator: cancelling a wait would end a generator."""

    def __init__(self, queue: asyncio.Queue[Ack]) -> None:
        self._queue = queue

    async def __anext__(self) -> Ack:
        return await self._queue.get()
