"""Who hears a topic, and what is kept to be said again."""

from collections.abc import Hashable, Iterator
from typing import Generic, NamedTuple, TypeVar

from device_agent.protocol import topics

C = TypeVar("C", bound=Hashable)

_REMEMBERED_TOPICS = 8_192
"""Topics whose hearers are remembered; beyond it all are forgotten and looked for again."""


def valid_filter(pattern: str, longest: int) -> bool:
    """Whether a filter's wildcards stand where MQTT allows them, and it is short enough."""
    if not pattern or len(pattern.encode()) > longest or "\0" in pattern:
        return False
    levels = pattern.split("/")
    if "#" in levels[:-1]:
        return False
    return all(level in ("+", "#") or not ("+" in level or "#" in level) for level in levels)


def valid_topic(topic: str, longest: int) -> bool:
    """Whether a topic may be published: short enough, no wildcard, not one of the broker's own (``$…``)."""
    return bool(topic) and len(topic.encode()) <= longest and topic[0] != "$" and not set(topic) & {"+", "#", "\0"}


class Subscriptions(Generic[C]):
    """Filters and the clients that hold them. A message costs one look-up: hearers are remembered by topic."""

    def __init__(self) -> None:
        self._exact: dict[str, dict[C, int]] = {}
        self._wild: dict[str, dict[C, int]] = {}
        self._hearers: dict[str, tuple[tuple[C, int], ...]] = {}

    def add(self, client: C, pattern: str, qos: int) -> None:
        """Let ``client`` hear ``pattern``; a filter it holds already gets the new QoS."""
        self._table(pattern).setdefault(pattern, {})[client] = qos
        self._hearers.clear()

    def remove(self, client: C, pattern: str) -> None:
        """Take one filter back; none held is no error."""
        table = self._table(pattern)
        holders = table.get(pattern, {})
        holders.pop(client, None)
        if not holders:
            table.pop(pattern, None)
        self._hearers.clear()

    def hearers(self, topic: str) -> tuple[tuple[C, int], ...]:
        """Each client that hears ``topic``, once, with the highest QoS of its filters that cover it."""
        known = self._hearers.get(topic)
        if known is not None:
            return known
        found: dict[C, int] = dict(self._exact.get(topic, {}))
        for pattern, holders in self._wild.items():
            if topics.matches(pattern, topic):
                for client, qos in holders.items():
                    found[client] = max(qos, found.get(client, 0))
        if len(self._hearers) >= _REMEMBERED_TOPICS:
            self._hearers.clear()
        result = self._hearers[topic] = tuple(found.items())
        return result

    def _table(self, pattern: str) -> dict[str, dict[C, int]]:
        return self._wild if "+" in pattern or "#" in pattern else self._exact


class Kept(NamedTuple):
    """One retained message and the client id that left it."""

    payload: bytes
    qos: int
    owner: str


class Retained:
    """Retained messages, bounded for each client that leaves them and together.

    In memory only: agents say theirs again on connecting, and after a restart of the broker everybody connects anew.
    """

    def __init__(self, *, per_client: int, total_bytes: int) -> None:
        self._per_client = per_client
        self._total_bytes = total_bytes
        self._bytes = 0
        self._by_topic: dict[str, Kept] = {}
        self._counts: dict[str, int] = {}

    def keep(self, topic: str, message: Kept) -> bool:
        """Keep the newest message of a topic; an empty one clears it.

        Returns:
            False where a bound is reached, and what was there before stays.
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

    def matching(self, pattern: str) -> Iterator[tuple[str, Kept]]:
        """What a new subscription to ``pattern`` has to be told."""
        if "+" not in pattern and "#" not in pattern:
            kept = self._by_topic.get(pattern)
            if kept is not None:
                yield pattern, kept
            return
        for topic, kept in list(self._by_topic.items()):
            if topics.matches(pattern, topic):
                yield topic, kept

    def _count(self, owner: str, change: int) -> None:
        count = self._counts.get(owner, 0) + change
        if count:
            self._counts[owner] = count
        else:
            self._counts.pop(owner, None)
