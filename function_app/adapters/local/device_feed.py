"""What devices say, by MQTT subscription, confirmed by hand after it is stored."""

import asyncio
import logging
from typing import NamedTuple

from paho.mqtt.client import MQTTMessage

from device_agent.protocol import topics
from device_agent.protocol.topics import ANY
from function_app.adapters.mqtt.connection import Broker, MqttConnection
from function_app.domain.common.problems import Problem
from function_app.ports.device_feed import BatchHandler, Handler
from function_app.ports.tables import StoreError

MAX_WAITING = 10_000
"""Messages read and not yet stored. More means that the store has stopped: then the oldest are let go."""
HOLD_ACK_S = 0.03
"""A call that waits for an ack writes it down itself: after this time it has, and the ingest finds nothing to change
instead of competing for the same rows in the middle of the call."""
READ_EVERY_S = 0.02
"""What is stored may wait a moment; a command or a robot's answer on the same machine may not."""
TRIES = 6
FIRST_PAUSE_S = 0.1

COLLECT_S = 2.0
COLLECT_LATE_S = 0.3
"""Brokers send about twenty messages before they wait for a confirmation: so this bounds what comes in a second."""
MAX_COLLECTED = 20_000
"""Measurements that wait to be stored: a hundred robots at 20 Hz for ten seconds."""
MAX_COLLECTED_BYTES = 32 * 1024 * 1024
TELEMETRY_TRIES = 3

FILTERS = (
    topics.conn(ANY, ANY),
    *(topics.device(ANY, ANY, ANY, kind) for kind in (topics.DESC, topics.STATE, topics.EVENT, topics.ACK)),
)
_log = logging.getLogger(__name__)


class _Arrived(NamedTuple):
    """One message, by which connection it came, and when (the event loop's clock) [s]."""

    message: MQTTMessage
    generation: int
    at_s: float


class MqttFeed:
    """``Feed`` over MQTT: one connection, one message at a time, so that every topic keeps its order."""

    def __init__(self, broker: Broker) -> None:
        self._waiting: asyncio.Queue[_Arrived] = asyncio.Queue(MAX_WAITING)
        self._link = MqttConnection(
            broker,
            subscriptions=FILTERS,
            receive=self._arrived,
            manual_ack=True,
            every_s=READ_EVERY_S,
        )

    async def run(self, handler: Handler) -> None:
        """See ``Feed``."""
        self._link.start()
        loop = asyncio.get_running_loop()
        try:
            while True:
                arrived = await self._waiting.get()
                if arrived.message.topic.endswith(f"/{topics.ACK}"):
                    await asyncio.sleep(max(0.0, arrived.at_s + HOLD_ACK_S - loop.time()))
                await self._store(arrived.message, handler)
                self._link.acknowledge(arrived.message, arrived.generation)
        finally:
            await self._link.close()

    async def _store(self, message: MQTTMessage, handler: Handler) -> None:
        """Hand it on, again while the store is busy or away for a moment.

        What cannot be stored in the end is logged and confirmed all the same: brokers stop sending after a number of
        unconfirmed messages, and one that fails for ever must not end the stream of all others.
        """
        pause_s = FIRST_PAUSE_S
        for attempt in range(TRIES):
            try:
                await handler(message.topic, bytes(message.payload))
            except (StoreError, Problem) as error:
                _log.warning("ingest of %s, try %d of %d: %s", message.topic, attempt + 1, TRIES, error)
            except Exception:  # noqa: BLE001 (whatever it is: the others go on)
                _log.exception("ingest of %s failed", message.topic)
                return
            else:
                return
            await asyncio.sleep(pause_s)
            pause_s *= 2

    def _arrived(self, message: MQTTMessage) -> None:
        if self._waiting.full():
            oldest = self._waiting.get_nowait()
            self._link.acknowledge(oldest.message, oldest.generation)
            _log.warning("ingest is behind: a message of %s was not stored", oldest.message.topic)
        self._waiting.put_nowait(_Arrived(message, self._link.generation, asyncio.get_running_loop().time()))


class MqttLate:
    """``Telemetry`` over MQTT for what was measured while a link was down: each is confirmed once it is stored."""

    def __init__(self, broker: Broker) -> None:
        self._collected: list[_Arrived] = []
        self._some = asyncio.Event()
        self._link = MqttConnection(
            broker,
            subscriptions=(topics.device(ANY, ANY, ANY, topics.LATE, ANY),),
            receive=self._arrived,
            manual_ack=True,
            every_s=READ_EVERY_S,
        )

    async def run(self, handler: BatchHandler) -> None:
        """See ``Telemetry``. How much waits is bounded by what a broker sends without a confirmation."""
        self._link.start()
        try:
            while True:
                await self._some.wait()
                await asyncio.sleep(COLLECT_LATE_S)
                batch, self._collected = self._collected, []
                self._some.clear()
                await self._store([(each.message.topic, bytes(each.message.payload)) for each in batch], handler)
                for each in batch:
                    self._link.acknowledge(each.message, each.generation)
        finally:
            await self._link.close()

    @staticmethod
    async def _store(batch: list[tuple[str, bytes]], handler: BatchHandler) -> None:
        """Until it is stored: there is no hurry, and the agents keep what is not confirmed."""
        while True:
            try:
                await handler(batch)
            except (StoreError, Problem) as error:
                _log.warning("late measurements: %s", error)
                await asyncio.sleep(COLLECT_S)
            except Exception:  # noqa: BLE001 (whatever it is: what comes next goes on)
                _log.exception("%d late measurements failed", len(batch))
                return
            else:
                return

    def _arrived(self, message: MQTTMessage) -> None:
        self._collected.append(_Arrived(message, self._link.generation, asyncio.get_running_loop().time()))
        self._some.set()


class MqttTelemetry:
    """``Telemetry`` over MQTT, by a connection of its own: measurements that queue up hold up no ack."""

    def __init__(self, broker: Broker) -> None:
        self._collected: list[tuple[str, bytes]] = []
        self._bytes = 0
        self._dropped = 0
        self._some = asyncio.Event()
        self._link = MqttConnection(
            broker,
            subscriptions=(topics.device(ANY, ANY, ANY, topics.TELE, ANY),),
            receive=self._arrived,
            qos=0,
            every_s=READ_EVERY_S,
        )

    async def run(self, handler: BatchHandler) -> None:
        """See ``Telemetry``."""
        self._link.start()
        try:
            while True:
                await self._some.wait()
                await asyncio.sleep(COLLECT_S)
                batch, self._collected, self._bytes = self._collected, [], 0
                self._some.clear()
                if self._dropped:
                    _log.warning("telemetry is behind: %d messages were dropped", self._dropped)
                    self._dropped = 0
                await self._store(batch, handler)
        finally:
            await self._link.close()

    @staticmethod
    async def _store(batch: list[tuple[str, bytes]], handler: BatchHandler) -> None:
        for attempt in range(TELEMETRY_TRIES):
            try:
                await handler(batch)
            except (StoreError, Problem) as error:
                _log.warning("telemetry, try %d of %d: %s", attempt + 1, TELEMETRY_TRIES, error)
                await asyncio.sleep(COLLECT_S)
            except Exception:  # noqa: BLE001 (whatever it is: what comes next goes on)
                _log.exception("%d messages of telemetry failed", len(batch))
                return
            else:
                return
        _log.warning("telemetry: %d messages were dropped", len(batch))

    def _arrived(self, message: MQTTMessage) -> None:
        payload = bytes(message.payload)
        if len(self._collected) >= MAX_COLLECTED or self._bytes + len(payload) > MAX_COLLECTED_BYTES:
            self._dropped += 1
            return
        self._collected.append((message.topic, payload))
        self._bytes += len(payload)
        self._some.set()
