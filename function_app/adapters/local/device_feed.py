"""Messages of devices from MQTT subscriptions of the server."""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Iterable
from itertools import repeat
from typing import NamedTuple

from paho.mqtt.client import MQTTMessage

from device_agent.protocol import topics
from device_agent.protocol.topics import ANY
from function_app.adapters.mqtt.connection import Broker, MqttConnection
from function_app.domain.common.problems import Problem
from function_app.ports.feeds import BatchHandler, Handler
from function_app.ports.tables import StoreError

MAX_WAITING = 10_000
"""Received messages that wait for storage. More means that the store has stopped; then the oldest are dropped."""
HOLD_ACK_S = 0.03
"""A call that waits for an ack stores that ack itself. The delay keeps the ingest from competing for the same rows."""
READ_EVERY_S = 0.02
"""Read period of the connections. Storage may wait; commands and responses on the same machine may not."""
TRIES = 6
FIRST_PAUSE_S = 0.1

COLLECT_S = 2.0
COLLECT_LATE_S = 0.3
"""A broker sends about twenty messages before it waits for an acknowledgement, which bounds the messages per second."""
MAX_COLLECTED = 20_000
"""Measurements that wait for storage: a hundred robots at 20 Hz for ten seconds."""
MAX_COLLECTED_BYTES = 32 * 1024 * 1024
TELEMETRY_TRIES = 3

FILTERS = (
    topics.conn(ANY, ANY),
    *(topics.device(ANY, ANY, ANY, kind) for kind in (topics.DESC, topics.STATE, topics.EVENT, topics.ACK)),
)
_log = logging.getLogger(__name__)


class _Received(NamedTuple):
    """One message, the generation of its connection, and when it was received by the event loop's clock [s]."""

    message: MQTTMessage
    generation: int
    at_s: float


async def _store(store: Callable[[], Awaitable[None]], what: str, pauses_s: Iterable[float]) -> bool:
    """Call ``store`` until it succeeds or the pauses run out. Returns whether the message needs no further attempt.

    An unforeseen error is logged and not retried: a message that always fails must not stop the others.
    """
    for number, pause_s in enumerate(pauses_s, 1):
        try:
            await store()
        except (StoreError, Problem) as error:
            _log.warning("%s, attempt %d: %s", what, number, error)
        except Exception:  # noqa: BLE001 (see above)
            _log.exception("%s failed", what)
            return True
        else:
            return True
        await asyncio.sleep(pause_s)
    return False


class MqttDeviceFeed:
    """``DeviceFeed`` over one MQTT connection. It stores one message at a time, so each topic keeps its order.

    A message that cannot be stored is logged and acknowledged: a broker stops sending after some unacknowledged
    messages.
    """

    def __init__(self, broker: Broker) -> None:
        self._waiting: asyncio.Queue[_Received] = asyncio.Queue(MAX_WAITING)
        self._connection = MqttConnection(
            broker, subscriptions=FILTERS, receive=self._receive, manual_ack=True, every_s=READ_EVERY_S
        )

    async def run(self, handler: Handler) -> None:
        self._connection.start()
        loop = asyncio.get_running_loop()
        pauses_s = [FIRST_PAUSE_S * 2**number for number in range(TRIES)]
        try:
            while True:
                message, generation, at_s = await self._waiting.get()
                if message.topic.endswith(f"/{topics.ACK}"):
                    await asyncio.sleep(max(0.0, at_s + HOLD_ACK_S - loop.time()))
                topic, payload = message.topic, bytes(message.payload)
                await _store(lambda: handler(topic, payload), f"ingest of {topic}", pauses_s)  # noqa: B023 (called here)
                self._connection.acknowledge(message, generation)
        finally:
            await self._connection.close()

    def _receive(self, message: MQTTMessage) -> None:
        if self._waiting.full():
            oldest = self._waiting.get_nowait()
            self._connection.acknowledge(oldest.message, oldest.generation)
            _log.warning("ingest is behind: dropped a message of %s", oldest.message.topic)
        self._waiting.put_nowait(_Received(message, self._connection.generation, asyncio.get_running_loop().time()))


class MqttTelemetryFeed:
    """``TelemetryFeed`` over a separate connection, so that queued measurements do not delay acks.

    Args:
        broker: The broker.
        late: Subscribe to measurements that were taken while an agent was offline. They are acknowledged after storage
            and retried without limit: agents store them until acknowledgement. Live measurements are dropped after
            some attempts or if too many wait.
    """

    def __init__(self, broker: Broker, *, late: bool = False) -> None:
        self._late = late
        self._collected: list[_Received] = []
        self._bytes = 0
        self._dropped = 0
        self._some = asyncio.Event()
        self._connection = MqttConnection(
            broker,
            subscriptions=(topics.device(ANY, ANY, ANY, topics.LATE if late else topics.TELE, ANY),),
            receive=self._receive,
            qos=1 if late else 0,
            manual_ack=late,
            every_s=READ_EVERY_S,
        )

    async def run(self, handler: BatchHandler) -> None:
        self._connection.start()
        try:
            while True:
                await self._some.wait()
                await asyncio.sleep(COLLECT_LATE_S if self._late else COLLECT_S)
                batch, self._collected, self._bytes = self._collected, [], 0
                self._some.clear()
                if self._dropped:
                    _log.warning("telemetry is behind: dropped %d messages", self._dropped)
                    self._dropped = 0
                await self.store([(each.message.topic, bytes(each.message.payload)) for each in batch], handler)
                if self._late:
                    for each in batch:
                        self._connection.acknowledge(each.message, each.generation)
        finally:
            await self._connection.close()

    async def store(self, batch: list[tuple[str, bytes]], handler: BatchHandler) -> None:
        """Store one batch. Late telemetry is retried without limit."""
        what = f"{len(batch)} messages of {'late ' if self._late else ''}telemetry"
        pauses_s = repeat(COLLECT_S) if self._late else repeat(COLLECT_S, TELEMETRY_TRIES)
        if not await _store(lambda: handler(batch), what, pauses_s):
            _log.warning("dropped %s", what)

    def _receive(self, message: MQTTMessage) -> None:
        size = len(message.payload)
        full = len(self._collected) >= MAX_COLLECTED or self._bytes + size > MAX_COLLECTED_BYTES
        if full and not self._late:
            self._dropped += 1
            return
        self._collected.append(_Received(message, self._connection.generation, asyncio.get_running_loop().time()))
        self._bytes += size
        self._some.set()
