"""Broker ports of the services, implemented with ``MemoryBroker``."""

import asyncio
import contextlib
import functools
import logging
import secrets
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Iterator, Sequence
from dataclasses import dataclass, field

from device_agent.protocol import Ack, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.security import grants
from device_agent.protocol.security.grants import Grant
from device_agent.protocol.topics import ANY
from function_app.domain.common.problems import Problem
from function_app.ports.broker_access import BrokerAccessError, Credentials, ServiceCredentials, check_revocation
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.feeds import BatchHandler, Handler
from function_app.ports.tables import StoreError
from tests.fakes.broker import RETRY_S, TRIES, MemoryBroker
from tests.harness.network.brokers import Message

_log = logging.getLogger(__name__)


class MemoryBrokerAccess:
    """``BrokerAccess`` of a ``MemoryBroker``. Credentials are a name and a random token."""

    def __init__(self, broker: MemoryBroker) -> None:
        self._broker = broker

    async def issue(self, grant: Grant) -> Credentials:
        grants.check(grant)
        self._require_broker()
        token = secrets.token_hex(16)
        self._broker.grants[token] = grant
        return Credentials(grant.principal, token)

    def accepts(self, publish: Sequence[str], subscribe: Sequence[str]) -> bool:
        del publish, subscribe
        return True

    async def revoke(self, *, client_id: str | None = None, principal: str | None = None) -> None:
        check_revocation(client_id, principal)
        self._require_broker()
        self._broker.revoke(lambda grant: grant.client_id == client_id or principal in grants.covering(grant.principal))

    async def expire(self, now_s: float) -> None:
        del now_s
        self._require_broker()
        self._broker.revoke(lambda grant: grant.expires_at <= self._broker.now_s())

    def service_credentials(self) -> ServiceCredentials:
        grant = grants.service_grant(
            client_id=f"service-{secrets.token_hex(8)}", token_id=secrets.token_hex(8), lifetime_s=24 * 3600
        )
        token = secrets.token_hex(16)
        self._broker.grants[token] = grant
        return ServiceCredentials(grant.client_id, grant.principal, token, float(grant.expires_at))

    async def close(self) -> None:
        """Nothing is open."""

    def _require_broker(self) -> None:
        if not self._broker.reachable:
            raise BrokerAccessError("the broker in memory cannot be reached")


@dataclass
class MemoryCommandBus:
    """``CommandBus`` of a ``MemoryBroker``."""

    broker: MemoryBroker
    _queues: dict[tuple[str, str], list[asyncio.Queue[Ack]]] = field(default_factory=dict)

    async def start(self) -> None:
        if self not in self.broker._subscribers:
            self.broker.attach(self)

    async def publish(self, topic: str, payload: bytes, *, qos: int = 1, retain: bool = False) -> None:
        await asyncio.sleep(0)
        if not self.broker.reachable:
            raise BusUnavailable("the broker at 127.0.0.1:1 cannot be reached")
        self.broker.publish(topic, payload, qos=qos, retain=retain)

    @contextlib.asynccontextmanager
    async def acks(self, device_topic: str, command: str) -> AsyncGenerator[AsyncIterator[Ack] | None]:
        await self.start()
        if not self.broker.reachable:
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
        return "ok" if self.broker.reachable else "the broker at 127.0.0.1:1 cannot be reached"

    async def close(self) -> None:
        self.broker.detach(self)

    def matches(self, topic: str) -> bool:
        return topic.endswith(f"/{topics.ACK}")

    def deliver(self, message: Message) -> None:
        with contextlib.suppress(ProtocolError):
            ack = codec.decode(message.payload, Ack)
            for queue in self._queues.get((message.topic, ack.id), ()):
                queue.put_nowait(ack)


class QueuedAcks(AsyncIterator[Ack]):
    """Acks that a connection has received."""

    def __init__(self, queue: asyncio.Queue[Ack]) -> None:
        self._queue = queue

    async def __anext__(self) -> Ack:
        return await self._queue.get()


class _MemorySubscription:
    """Queues received messages and stores them sequentially."""

    filters: tuple[str, ...]

    def __init__(self, broker: MemoryBroker) -> None:
        self.broker = broker
        self._queue: asyncio.Queue[tuple[str, bytes]] = asyncio.Queue()

    def matches(self, topic: str) -> bool:
        return any(topics.matches(pattern, topic) for pattern in self.filters)

    def deliver(self, message: Message) -> None:
        self._queue.put_nowait((message.topic, message.payload))

    async def stored(self) -> None:
        await self._queue.join()

    @contextlib.contextmanager
    def _attached(self) -> Iterator[None]:
        self.broker.attach_feed(self)
        try:
            yield
        finally:
            self.broker.detach_feed(self)


class MemoryFeed(_MemorySubscription):
    """``DeviceFeed`` of a ``MemoryBroker``."""

    filters = (
        topics.conn(ANY, ANY),
        *(topics.device(ANY, ANY, ANY, kind) for kind in (topics.DESC, topics.STATE, topics.EVENT, topics.ACK)),
    )

    async def run(self, handler: Handler) -> None:
        with self._attached():
            while True:
                topic, payload = await self._queue.get()
                await _store(functools.partial(handler, topic, payload), topic)
                self._queue.task_done()


class MemoryTelemetry(_MemorySubscription):
    """``TelemetryFeed`` of a ``MemoryBroker``; ``late``: only backfilled measurements."""

    def __init__(self, broker: MemoryBroker, *, late: bool = False) -> None:
        super().__init__(broker)
        self.filters = (topics.device(ANY, ANY, ANY, topics.LATE if late else topics.TELE, ANY),)

    async def run(self, handler: BatchHandler) -> None:
        with self._attached():
            while True:
                batch = [await self._queue.get()]
                batch += [self._queue.get_nowait() for _ in range(self._queue.qsize())]
                await _store(functools.partial(handler, batch), "telemetry")
                for _ in batch:
                    self._queue.task_done()


async def _store(handle: Callable[[], Awaitable[None]], name: str) -> None:
    for _ in range(TRIES):
        try:
            return await handle()
        except (StoreError, Problem) as error:
            _log.warning("ingest of %s: %s", name, error)
            await asyncio.sleep(RETRY_S)
        except Exception:  # noqa: BLE001 (continue with the next message)
            _log.exception("ingest of %s failed", name)
            return None
    return None
