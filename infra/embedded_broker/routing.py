"""Subscriptions and retained messages."""

from collections.abc import Hashable, Iterator
from typing import Generic, NamedTuple, TypeVar

from device_agent.protocol import topics

C = TypeVar("C", bound=Hashable)

_CACHED_TOPICS = 8_192
"""Number of topics with cached subscribers; the cache is cleared beyond it."""


def valid_filter(pattern: str, longest: int) -> bool:
    """Whether a filter is short enough and its wildcards are at valid positions."""
    if not pattern or len(pattern.encode()) > longest or "\0" in pattern:
        return False
    levels = pattern.split("/")
    if "#" in levels[:-1]:
        return False
    return all(level in ("+", "#") or not ("+" in level or "#" in level) for level in levels)


def valid_topic(topic: str, longest: int) -> bool:
    """Whether a topic may be published: short enough, no wildcard, not ``$…``."""
    return bool(topic) and len(topic.encode()) <= longest and topic[0] != "$" and not set(topic) & {"+", "#", "\0"}


class Subscriptions(Generic[C]):
    """Filters of all clients. Subscribers are cached by topic, so a message costs one look-up."""

    def __init__(self) -> None:
        self._exact: dict[str, dict[C, int]] = {}
        self._wild: dict[str, dict[C, int]] = {}
        self._subscribers: dict[str, tuple[tuple[C, int], ...]] = {}

    def add(self, client: C, pattern: str, qos: int) -> None:
        """Add a filter of a client, or change its QoS."""
        self._table(pattern).setdefault(pattern, {})[client] = qos
        self._subscribers.clear()

    def remove(self, client: C, pattern: str) -> None:
        """Remove a filter, if present."""
        table = self._table(pattern)
        holders = table.get(pattern, {})
        holders.pop(client, None)
        if not holders:
            table.pop(pattern, None)
        self._subscribers.clear()

    def subscribers(self, topic: str) -> tuple[tuple[C, int], ...]:
        """Each subscriber of ``topic`` once, with the highest QoS of its matching filters."""
        cached = self._subscribers.get(topic)
        if cached is not None:
            return cached
        matching: dict[C, int] = dict(self._exact.get(topic, {}))
        for pattern, holders in self._wild.items():
            if topics.matches(pattern, topic):
                for client, qos in holders.items():
                    matching[client] = max(qos, matching.get(client, 0))
        if len(self._subscribers) >= _CACHED_TOPICS:
            self._subscribers.clear()
        result = self._subscribers[topic] = tuple(matching.items())
        return result

    def _table(self, pattern: str) -> dict[str, dict[C, int]]:
        return self._wild if "+" in pattern or "#" in pattern else self._exact


class RetainedMessage(NamedTuple):
    """One retained message and the client id of its publisher."""

    payload: bytes
    qos: int
    owner: str


class RetainedMessages:
    """Retained messages, limited per publisher and in total.

    In memory only: after a restart of the broker, agents reconnect and publish their retained messages again.
    """

    def __init__(self, *, per_client: int, total_bytes: int) -> None:
        self._per_client = per_client
        self._total_bytes = total_bytes
        self._bytes = 0
        self._by_topic: dict[str, RetainedMessage] = {}
        self._counts: dict[str, int] = {}

    def store(self, topic: str, message: RetainedMessage) -> bool:
        """Store the newest message of a topic; an empty one deletes it.

        Returns:
            False if a limit is reached; the previous message then remains.
        """
        old = self._by_topic.get(topic)
        new_owner = old is None or old.owner != message.owner
        if message.payload:
            size = self._bytes + len(message.payload) - (len(old.payload) if old else 0)
            full = new_owner and self._counts.get(message.owner, 0) >= self._per_client
            if full or size > self._total_bytes:
                return False
        if old is not None:
            del self._by_topic[topic]
            self._bytes -= len(old.payload)
            self._count(old.owner, -1)
        if message.payload:
            self._by_topic[topic] = message
            self._bytes += len(message.payload)
            self._count(message.owner, 1)
        return True

    def matching(self, pattern: str) -> Iterator[tuple[str, RetainedMessage]]:
        """RetainedMessages messages for a new subscription."""
        if "+" not in pattern and "#" not in pattern:
            message = self._by_topic.get(pattern)
            if message is not None:
                yield pattern, message
            return
        for topic, message in list(self._by_topic.items()):
            if topics.matches(pattern, topic):
                yield topic, message

    def _count(self, owner: str, change: int) -> None:
        count = self._counts.get(owner, 0) + change
        if count:
            self._counts[owner] = count
        else:
            self._counts.pop(owner, None)
