"""MQTT connections of function instances and workers: the command bus and the feed of device messages."""

import asyncio
import contextlib
from collections.abc import AsyncGenerator, AsyncIterator
from typing import TYPE_CHECKING

from device_agent.protocol import Ack, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.topics import ANY
from function_app.domain.common.problems import Problem
from function_app.ports.broker_access import BrokerAccess, Credentials
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.feeds import BatchHandler, Handler
from function_app.ports.tables import StoreError
from tests.fakes.broker_ports import QueuedAcks
from tests.simulation.network.broker import Link, Packet
from tests.simulation.network.wires import CLOUD

if TYPE_CHECKING:
    from tests.simulation.actors.instance import Instance

CONFIRM_S = 5.0
READY_S = 2.0
KEEP_ALIVE_S = 30.0
FIRST_RETRY_S, LAST_RETRY_S = 0.1, 5.0
HOLD_ACK_S = 0.03
RENEW_BEFORE_S, CHECK_S = 30.0, 1.0
TRIES = 6


class CloudConnection:
    """A connection that reconnects, with the behaviour of ``function_app.adapters.mqtt.connection``."""

    def __init__(self, instance: "Instance", access: BrokerAccess, filters: tuple[str, ...], *, manual: bool) -> None:
        self._instance = instance
        self._access = access
        self._filters = dict.fromkeys(filters, 1)
        self._manual = manual
        self._link: Link | None = None
        self._current: Link | None = None
        self._ready = asyncio.Event()
        self._lost = asyncio.Event()
        self._connected: asyncio.Future[None] | None = None
        self._waiting: dict[int, asyncio.Future[None]] = {}
        self._number = 0
        self._task: asyncio.Task[None] | None = None
        self.last_traffic_s = 0.0

    def connect(self) -> None:
        """Connect, without waiting. Idempotent."""
        if self._task is None:
            self._task = self._instance.spawn(self._run())

    async def ready(self) -> bool:
        """Wait a short time until connected."""
        self.connect()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(READY_S):
                await self._ready.wait()
        return self._ready.is_set()

    async def publish(self, topic: str, payload: bytes, *, qos: int, retain: bool) -> None:
        """Publish, and wait for the acknowledgement. Raises ``BusUnavailable``."""
        await self._instance.step()
        if not await self.ready() or self._link is None:
            raise BusUnavailable("the broker cannot be reached")
        self._number += 1
        self._link.publish(Packet(topic, payload, qos, retain, self._number))
        if not qos:
            return
        acknowledged = self._waiting[self._number] = self._instance.loop.create_future()
        number = self._number
        try:
            async with asyncio.timeout(CONFIRM_S):
                await acknowledged
        except TimeoutError as error:
            raise BusUnavailable("the broker did not acknowledge a message") from error
        finally:
            self._waiting.pop(number, None)
        await self._instance.step()

    def received(self, packet: Packet, link: Link) -> None:
        """Handle a packet; overridden."""
        raise NotImplementedError

    def killed(self) -> None:
        """The process ended: its machine resets the connection."""
        if self._current is not None:
            self._current.drop()

    async def _run(self) -> None:
        pause_s = FIRST_RETRY_S
        loop = self._instance.loop
        while True:
            self._lost.clear()
            self._connected = loop.create_future()
            credentials = self._access.service_credentials()
            link = self._instance.broker.connect(
                CLOUD,
                credentials.client_id,
                Credentials(credentials.username, credentials.password),
                self,
                keep_alive_s=KEEP_ALIVE_S,
            )
            self._current = link
            try:
                async with asyncio.timeout(CONFIRM_S):
                    await self._connected
                self._link = link
                self._ready.set()
                pause_s = FIRST_RETRY_S
                await self._maintain(link, credentials.expires_at)
            except (BusUnavailable, TimeoutError):
                pass
            self._ready.clear()
            self._link = None
            link.drop()
            for future in self._waiting.values():
                if not future.done():
                    future.set_exception(BusUnavailable("the connection was lost"))
                    future.exception()
            self._waiting.clear()
            await asyncio.sleep(pause_s)
            pause_s = min(2 * pause_s, LAST_RETRY_S)

    async def _maintain(self, link: Link, expires_at: float) -> None:
        """Return when the connection is lost or its credentials are about to expire."""
        loop = self._instance.loop
        self.last_traffic_s = pinged_s = loop.time()
        while not self._lost.is_set() and self._instance.broker.now_s() < expires_at - RENEW_BEFORE_S:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CHECK_S):
                    await self._lost.wait()
            if loop.time() - self.last_traffic_s > 1.5 * KEEP_ALIVE_S:
                return
            if loop.time() - pinged_s > KEEP_ALIVE_S / 2:
                link.ping()
                pinged_s = loop.time()

    # ------------------------------------------------------------ callbacks

    def on_connected(self, accepted: bool) -> None:
        if self._instance.alive and accepted and self._current is not None:
            self._current.subscribe(self._filters)
        elif self._connected is not None and not self._connected.done():
            self._connected.set_exception(BusUnavailable("the broker rejected the connection"))

    def on_subscribed(self, accepted: bool) -> None:
        if self._connected is not None and not self._connected.done():
            if accepted:
                self._connected.set_result(None)
            else:
                self._connected.set_exception(BusUnavailable("the broker rejected a subscription"))

    def on_packet(self, packet: Packet) -> None:
        self.last_traffic_s = self._instance.loop.time()
        if not self._instance.alive or self._current is None:
            return
        if packet.qos and not self._manual:
            self._current.acknowledge(packet.number)
        self.received(packet, self._current)

    def on_published(self, number: int) -> None:
        self.last_traffic_s = self._instance.loop.time()
        waiting = self._waiting.get(number)
        if waiting is not None and not waiting.done():
            waiting.set_result(None)

    def on_traffic(self) -> None:
        self.last_traffic_s = self._instance.loop.time()

    def on_closed(self) -> None:
        self._lost.set()
        if self._connected is not None and not self._connected.done():
            self._connected.set_exception(BusUnavailable("the broker closed the connection"))
            self._connected.exception()


class SimulatedBus(CloudConnection):
    """``CommandBus`` of one instance."""

    def __init__(self, instance: "Instance", access: BrokerAccess) -> None:
        super().__init__(instance, access, (topics.device(ANY, ANY, ANY, topics.ACK),), manual=False)
        self._queues: dict[tuple[str, str], list[asyncio.Queue[Ack]]] = {}

    async def start(self) -> None:
        self.connect()

    async def publish(self, topic: str, payload: bytes, *, qos: int = 1, retain: bool = False) -> None:
        await super().publish(topic, payload, qos=qos, retain=retain)

    @contextlib.asynccontextmanager
    async def acks(self, device_topic: str, command: str) -> AsyncGenerator[AsyncIterator[Ack] | None]:
        if not await self.ready():
            yield None
            return
        received: asyncio.Queue[Ack] = asyncio.Queue()
        queues = self._queues.setdefault((f"{device_topic}/{topics.ACK}", command), [])
        queues.append(received)
        try:
            yield QueuedAcks(received)
        finally:
            queues.remove(received)

    async def status(self) -> str:
        return "ok"

    async def close(self) -> None:
        """Nothing is open."""

    def received(self, packet: Packet, link: Link) -> None:
        del link
        with contextlib.suppress(ProtocolError):
            ack = codec.decode(packet.payload, Ack)
            for queue in self._queues.get((packet.topic, ack.id), ()):
                queue.put_nowait(ack)


class SimulatedFeed(CloudConnection):
    """``DeviceFeed`` of a worker: a clean session; a message is acknowledged after it was stored."""

    def __init__(self, instance: "Instance", access: BrokerAccess) -> None:
        kinds = (topics.DESC, topics.STATE, topics.EVENT, topics.ACK)
        filters = (topics.conn(ANY, ANY), *(topics.device(ANY, ANY, ANY, kind) for kind in kinds))
        super().__init__(instance, access, filters, manual=True)
        self._messages: asyncio.Queue[tuple[Packet, Link, float]] = asyncio.Queue()

    async def run(self, handler: Handler) -> None:
        self.connect()
        loop = self._instance.loop
        while True:
            packet, link, at_s = await self._messages.get()
            if packet.topic.endswith(f"/{topics.ACK}"):
                await asyncio.sleep(max(0.0, at_s + HOLD_ACK_S - loop.time()))
            await self._instance.step()
            await self._store(handler, packet)
            if link is self._current:
                link.acknowledge(packet.number)

    async def _store(self, handler: Handler, packet: Packet) -> None:
        for number in range(TRIES):
            try:
                await handler(packet.topic, packet.payload)
            except (StoreError, Problem):
                await asyncio.sleep(0.1 * 2**number)
            else:
                return

    def received(self, packet: Packet, link: Link) -> None:
        self._messages.put_nowait((packet, link, self._instance.loop.time()))


class NoTelemetry:
    """``TelemetryFeed`` that receives nothing: no check depends on stored measurements."""

    async def run(self, handler: BatchHandler) -> None:
        del handler
        await asyncio.Event().wait()
