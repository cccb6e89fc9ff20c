"""Publishes to the broker what may be lost: messages that arrived by HTTP or XMPP, and confirmations for agents."""

import asyncio
import logging
from collections.abc import Iterable

from device_agent.protocol import codec, topics
from device_agent.protocol.topics import Topic
from function_app.ports.clock import Clock
from function_app.ports.command_bus import BusUnavailable, CommandBus

TIMEOUT_S = 2.0
"""Time limit, so that an unreachable broker does not delay an agent's request."""
PAUSE_MS = 5_000
"""Pause after a failure."""
_RETAINED = frozenset({topics.CONN, topics.DESC, topics.STATE})
_AT_MOST_ONCE = frozenset({topics.TELE, topics.STORED})

_log = logging.getLogger(__name__)


class BrokerRelay:
    """Publishes messages, best effort."""

    def __init__(self, *, bus: CommandBus, clock: Clock) -> None:
        self._bus = bus
        self._clock = clock
        self._paused_until_ms = 0

    async def publish(self, messages: Iterable[tuple[str, Topic, bytes]]) -> None:
        """Publish messages in order per topic, retained where the wire contract requires it."""
        if 0 < self._paused_until_ms - self._clock.now_ms() <= PAUSE_MS:  # otherwise the clock was set back
            return
        by_topic: dict[str, list[tuple[Topic, bytes]]] = {}
        for topic, parsed, payload in messages:
            by_topic.setdefault(topic, []).append((parsed, payload))
        try:
            async with asyncio.timeout(TIMEOUT_S), asyncio.TaskGroup() as group:
                for topic, topic_messages in by_topic.items():
                    group.create_task(self._publish(topic, topic_messages))
        except* (BusUnavailable, TimeoutError) as errors:
            self._paused_until_ms = self._clock.now_ms() + PAUSE_MS
            _log.warning("relayed messages are not published: %s", errors.exceptions[0])

    async def _publish(self, topic: str, topic_messages: Iterable[tuple[Topic, bytes]]) -> None:
        for parsed, payload in topic_messages:
            retain = parsed.kind in _RETAINED
            if retain and len(payload) > codec.MAX_RETAINED_BYTES:
                _log.warning("%s is too long for a retained message", topic)
                continue
            await self._bus.publish(topic, payload, qos=0 if parsed.kind in _AT_MOST_ONCE else 1, retain=retain)
