"""A broker in memory, and the ports that the services reach it by.

Messages are delivered in order and in the caller's turn. ``MemoryFeed`` hands them to the ingest on the event loop;
``MemoryBroker.idle`` waits until the ingest has stored them all.
"""

import asyncio
import contextlib
import functools
import logging
import queue
import secrets
import threading
import time
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, Self

from device_agent.protocol import Ack, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.security import grants
from device_agent.protocol.security.grants import Grant
from device_agent.protocol.topics import ANY
from function_app.domain.common.problems import Problem
from function_app.ports.broker_access import BrokerAccessError, Credentials, ServiceCredentials
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.device_feed import BatchHandler, Handler
from function_app.ports.tables import StoreError
from tests.harness.network.brokers import Message

TRIES = 6
RETRY_S = 1.0
SUBACK_FAILURE = 128
_log = logging.getLogger(__name__)


class Subscriber(Protocol):
    """A connection to the broker, as the broker sees it."""

    def matches(self, topic: str) -> bool: ...

    def deliver(self, message: Message) -> None: ...


class MemoryBroker:
    """Publish and subscribe with retained messages, wildcards and grants.

    Attributes:
        settle: Waits until everything that was published is stored.
        reachable: A test sets it to ``False`` to let every publication and every change of rights fail.
    """

    def __init__(self, *, now_s: Callable[[], float] = time.time) -> None:
        self.reachable = True
        self.now_s = now_s
        self.grants: dict[str, Grant] = {}
        self.connections: dict[str, MemoryConnection] = {}
        self.settle: Callable[[], None] = lambda: None
        self._subscribers: list[Subscriber] = []
        self._retained: dict[str, bytes] = {}
        self._queue: deque[Message] = deque()
        self._delivering = False
        self._feeds: list[MemoryFeed | MemoryTelemetry] = []

    def publish(self, topic: str, payload: bytes, *, qos: int = 1, retain: bool = False) -> None:
        """Deliver to every subscriber; a publication from within a delivery follows after it."""
        if retain and payload:
            self._retained[topic] = payload
        elif retain:
            self._retained.pop(topic, None)
        self._queue.append(Message(topic, payload, qos, retain=False))
        if self._delivering:
            return
        self._delivering = True
        try:
            while self._queue:
                message = self._queue.popleft()
                for subscriber in tuple(self._subscribers):
                    if subscriber.matches(message.topic):
                        subscriber.deliver(message)
        finally:
            self._delivering = False

    def grant(self, client_id: str, *, publish: tuple[str, ...] = (), subscribe: tuple[str, ...] = ()) -> Grant:
        """A grant for five minutes."""
        return Grant(
            principal=f"account:{client_id}",
            client_id=client_id,
            publish=publish,
            subscribe=subscribe,
            token_id=secrets.token_hex(8),
            expires_at=int(self.now_s() + 300),
        )

    def connect(self, client_id: str, credentials: Credentials | None, **options: Any) -> "MemoryConnection":
        """A client that has tried to connect."""
        return MemoryConnection(self, client_id, credentials, settle=self.settle, **options).open()

    def retained(self, pattern: str) -> list[Message]:
        return [
            Message(topic, payload, 1, retain=True)
            for topic, payload in self._retained.items()
            if topics.matches(pattern, topic)
        ]

    def attach(self, subscriber: Subscriber) -> None:
        self._subscribers.append(subscriber)

    def detach(self, subscriber: Subscriber) -> None:
        if subscriber in self._subscribers:
            self._subscribers.remove(subscriber)

    def attach_feed(self, feed: "MemoryFeed | MemoryTelemetry") -> None:
        self._feeds.append(feed)
        self.attach(feed)
        for pattern in feed.filters:
            for message in self.retained(pattern):
                feed.deliver(message)

    def detach_feed(self, feed: "MemoryFeed | MemoryTelemetry") -> None:
        self._feeds.remove(feed)
        self.detach(feed)

    async def idle(self) -> None:
        """Wait until every message that has been published is stored."""
        for feed in tuple(self._feeds):
            await feed.stored()

    def revoke(self, covered: Callable[[Grant], bool]) -> None:
        """Drop the grants that match, and end the connections made with them."""
        for username in [username for username, grant in self.grants.items() if covered(grant)]:
            del self.grants[username]
        for connection in [each for each in self.connections.values() if each.grant and covered(each.grant)]:
            connection.vanish()


class MemoryConnection:
    """One client's connection. The same surface as ``tests.harness.network.brokers.Client``."""

    def __init__(
        self,
        broker: MemoryBroker,
        client_id: str,
        credentials: Credentials | None,
        *,
        will: Message | None = None,
        settle: Callable[[], None] = lambda: None,
        on_message: Callable[[Message], None] | None = None,
    ) -> None:
        self.client_id = client_id
        self.messages: queue.Queue[Message] = queue.Queue()
        self.answer = ""
        self.connected = threading.Event()
        self.disconnected = threading.Event()
        self.grant: Grant | None = None
        self.will = will
        self._broker = broker
        self._credentials = credentials
        self._filters: list[str] = []
        self._settle = settle
        self._on_message = on_message

    def open(self) -> Self:
        username, token = self._credentials or ("", "")
        grant = self._broker.grants.get(token)
        wrong = grant is None or (grant.principal, grant.client_id) != (username, self.client_id)
        if grant is None or wrong or (self.will is not None and not grant.may_publish(self.will.topic)):
            self.answer = "Not authorized"
            self.disconnected.set()
            return self
        self.answer = "Success"
        self.grant = grant
        earlier = self._broker.connections.get(self.client_id)
        if earlier is not None:
            earlier.vanish()
        self._broker.connections[self.client_id] = self
        self._broker.attach(self)
        self.connected.set()
        return self

    def subscribe(self, *filters: str, qos: int = 1) -> list[int]:
        """The SUBACK's codes."""
        codes = []
        for pattern in filters:
            allowed = self.grant is not None and self.grant.may_subscribe(pattern)
            codes.append(qos if allowed else SUBACK_FAILURE)
            if allowed:
                self._filters.append(pattern)
                for message in self._broker.retained(pattern):
                    self._receive(message)
        return codes

    def publish(self, topic: str, payload: bytes | str = b"", *, qos: int = 1, retain: bool = False) -> int:
        content = payload.encode() if isinstance(payload, str) else payload
        if self.is_open and self.grant is not None and self.grant.may_publish(topic):
            self._broker.publish(topic, content, qos=qos, retain=retain)
        return 0

    def acknowledged(self, mid: int) -> bool:
        del mid
        return self.is_open

    def publish_acknowledged(self, topic: str, payload: bytes | str = b"", *, retain: bool = False) -> None:
        """Publish, and return once the ingest has stored the message and all that followed from it."""
        self.publish(topic, payload, retain=retain)
        self._settle()

    def receive(self, timeout_s: float = 0) -> Message:
        del timeout_s
        assert not self.messages.empty(), f"{self.client_id} received nothing"
        return self.messages.get_nowait()

    def pending(self) -> list[Message]:
        """The messages that were not received yet."""
        return [self.messages.get_nowait() for _ in range(self.messages.qsize())]

    @property
    def is_open(self) -> bool:
        return self._broker.connections.get(self.client_id) is self

    def vanish(self) -> None:
        """End without DISCONNECT, so that the broker publishes the will."""
        will = self.will if self.is_open else None
        self.close()
        if will is not None:
            self._broker.publish(will.topic, will.payload, qos=will.qos, retain=will.retain)

    def close(self) -> None:
        if self.is_open:
            del self._broker.connections[self.client_id]
        self._broker.detach(self)
        self.disconnected.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def matches(self, topic: str) -> bool:
        return any(topics.matches(pattern, topic) for pattern in self._filters)

    def deliver(self, message: Message) -> None:
        self._receive(message)

    def _receive(self, message: Message) -> None:
        self.messages.put(message)
        if self._on_message is not None:
            self._on_message(message)


class MemoryBrokerAccess:
    """``BrokerAccess`` of a ``MemoryBroker``: credentials are a name and a token that the broker looks up."""

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
        if (client_id is None) == (principal is None):
            raise ValueError("revoke takes exactly one of client_id and principal")
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
    _waiting: dict[tuple[str, str], list[asyncio.Queue[Ack]]] = field(default_factory=dict)

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
        waiting: asyncio.Queue[Ack] = asyncio.Queue()
        queues = self._waiting.setdefault((f"{device_topic}/{topics.ACK}", command), [])
        queues.append(waiting)
        try:
            yield _Acks(waiting)
        finally:
            queues.remove(waiting)

    async def status(self) -> str:
        return "ok" if self.broker.reachable else "the broker at 127.0.0.1:1 cannot be reached"

    async def close(self) -> None:
        self.broker.detach(self)

    def matches(self, topic: str) -> bool:
        return topic.endswith(f"/{topics.ACK}")

    def deliver(self, message: Message) -> None:
        with contextlib.suppress(ProtocolError):
            ack = codec.decode(message.payload, Ack)
            for waiting in self._waiting.get((message.topic, ack.id), ()):
                waiting.put_nowait(ack)


class _Acks(AsyncIterator[Ack]):
    def __init__(self, waiting: asyncio.Queue[Ack]) -> None:
        self._waiting = waiting

    async def __anext__(self) -> Ack:
        return await self._waiting.get()


class _Arrived(NamedTuple):
    topic: str
    payload: bytes


class _MemorySubscription:
    """What the feeds share: a queue of messages, stored one after another."""

    filters: tuple[str, ...]

    def __init__(self, broker: MemoryBroker) -> None:
        self.broker = broker
        self._queue: asyncio.Queue[_Arrived] = asyncio.Queue()

    def matches(self, topic: str) -> bool:
        return any(topics.matches(pattern, topic) for pattern in self.filters)

    def deliver(self, message: Message) -> None:
        self._queue.put_nowait(_Arrived(message.topic, message.payload))

    async def stored(self) -> None:
        await self._queue.join()


class MemoryFeed(_MemorySubscription):
    """``DeviceFeed`` of a ``MemoryBroker``."""

    filters = (
        topics.conn(ANY, ANY),
        *(topics.device(ANY, ANY, ANY, kind) for kind in (topics.DESC, topics.STATE, topics.EVENT, topics.ACK)),
    )

    async def run(self, handler: Handler) -> None:
        self.broker.attach_feed(self)
        try:
            while True:
                message = await self._queue.get()
                await _store(functools.partial(handler, *message), message.topic)
                self._queue.task_done()
        finally:
            self.broker.detach_feed(self)


class MemoryTelemetry(_MemorySubscription):
    """``TelemetryFeed`` of a ``MemoryBroker``: by default measurements, with ``late`` those of an interrupted link."""

    def __init__(self, broker: MemoryBroker, *, late: bool = False) -> None:
        super().__init__(broker)
        self.filters = (topics.device(ANY, ANY, ANY, topics.LATE if late else topics.TELE, ANY),)

    async def run(self, handler: BatchHandler) -> None:
        self.broker.attach_feed(self)
        try:
            while True:
                batch = [await self._queue.get()]
                batch += [self._queue.get_nowait() for _ in range(self._queue.qsize())]
                await _store(functools.partial(handler, batch), "telemetry")
                for _ in batch:
                    self._queue.task_done()
        finally:
            self.broker.detach_feed(self)


async def _store(handle: Callable[[], Awaitable[None]], name: str) -> None:
    for _ in range(TRIES):
        try:
            return await handle()
        except (StoreError, Problem) as error:
            _log.warning("ingest of %s: %s", name, error)
            await asyncio.sleep(RETRY_S)
        except Exception:  # noqa: BLE001 (the next message goes on)
            _log.exception("ingest of %s failed", name)
            return None
    return None
