"""What came by another way than the broker, told there too: for the console, and for whoever else listens."""

import asyncio
import logging
from collections.abc import Iterable

from device_agent.protocol import codec, topics
from device_agent.protocol.topics import Topic
from function_app.ports.clock import Clock
from function_app.ports.command_bus import BusUnavailable, CommandBus

GIVE_UP_S = 2.0
"""An agent's request is not held up longer than this by a broker that is away."""
REST_MS = 5_000
"""After a failure the broker is left alone for this long."""
_RETAINED = frozenset({topics.CONN, topics.DESC, topics.STATE})

_log = logging.getLogger(__name__)


class BrokerRelay:
    """Publishes as well as it can: what is passed on is stored already."""

    def __init__(self, *, bus: CommandBus, clock: Clock) -> None:
        self._bus = bus
        self._clock = clock
        self._rests_until_ms = 0

    async def publish(self, told: Iterable[tuple[str, Topic, bytes]]) -> None:
        """Publish messages, those of one topic in order, retained where the contract says so."""
        if self._clock.now_ms() < self._rests_until_ms:
            return
        by_topic: dict[str, list[tuple[Topic, bytes]]] = {}
        for topic, parsed, payload in told:
            by_topic.setdefault(topic, []).append((parsed, payload))
        try:
            async with asyncio.timeout(GIVE_UP_S), asyncio.TaskGroup() as group:
                for topic, messages in by_topic.items():
                    group.create_task(self._publish(topic, messages))
        except* (BusUnavailable, TimeoutError) as errors:
            self._rests_until_ms = self._clock.now_ms() + REST_MS
            _log.warning("what did not come by the broker does not reach it: %s", errors.exceptions[0])

    async def _publish(self, topic: str, messages: Iterable[tuple[Topic, bytes]]) -> None:
        for parsed, payload in messages:
            retain = parsed.kind in _RETAINED
            if retain and len(payload) > codec.MAX_RETAINED_BYTES:
                _log.warning("%s is too long to be retained on the broker", topic)
                continue
            await self._bus.publish(topic, payload, qos=0 if parsed.kind == topics.TELE else 1, retain=retain)
