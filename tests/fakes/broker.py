"""A broker in memory that delivers messages in order, in the publisher's thread."""

import queue
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol, Self

from device_agent.protocol import topics
from device_agent.protocol.security.grants import Grant
from function_app.ports.broker_access import Credentials
from tests.harness.network.brokers import Message

TRIES = 6
RETRY_S = 1.0
SUBACK_FAILURE = 128


class Subscriber(Protocol):
    """A connection, as used by the broker."""

    def matches(self, topic: str) -> bool: ...

    def deliver(self, message: Message) -> None: ...


class Feed(Subscriber, Protocol):
    """A subscription that stores what it receives."""

    filters: tuple[str, ...]

    async def stored(self) -> None:
        """Return after the handler processed every delivered message."""


class MemoryBroker:
    """Publish and subscribe with retained messages, wildcards and grants.

    Attributes:
        settle: Waits until all published messages are stored.
        reachable: ``False``: publications and changes of permissions fail.
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
        self._feeds: list[Feed] = []

    def publish(self, topic: str, payload: bytes, *, qos: int = 1, retain: bool = False) -> None:
        """Deliver to every subscriber. Messages published during a delivery are queued."""
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
        """A client after its connection attempt."""
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

    def attach_feed(self, feed: Feed) -> None:
        self._feeds.append(feed)
        self.attach(feed)
        for pattern in feed.filters:
            for message in self.retained(pattern):
                feed.deliver(message)

    def detach_feed(self, feed: Feed) -> None:
        self._feeds.remove(feed)
        self.detach(feed)

    async def idle(self) -> None:
        """Wait until all published messages are stored."""
        for feed in tuple(self._feeds):
            await feed.stored()

    def revoke(self, covered: Callable[[Grant], bool]) -> None:
        """Delete matching grants, and close their connections."""
        for username in [username for username, grant in self.grants.items() if covered(grant)]:
            del self.grants[username]
        for connection in [each for each in self.connections.values() if each.grant and covered(each.grant)]:
            connection.vanish()


class MemoryConnection:
    """A client connection with the interface of ``tests.harness.network.brokers.Client``."""

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
        """Subscribe; return the SUBACK codes."""
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
        """Publish, and return after the ingest has stored the message and all resulting messages."""
        self.publish(topic, payload, retain=retain)
        self._settle()

    def receive(self, timeout_s: float = 0) -> Message:
        del timeout_s
        assert not self.messages.empty(), f"{self.client_id} received nothing"
        return self.messages.get_nowait()

    def pending(self) -> list[Message]:
        """Received messages that were not read yet."""
        return [self.messages.get_nowait() for _ in range(self.messages.qsize())]

    @property
    def is_open(self) -> bool:
        return self._broker.connections.get(self.client_id) is self

    def vanish(self) -> None:
        """Close without DISCONNECT, so that the broker publishes the will."""
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
