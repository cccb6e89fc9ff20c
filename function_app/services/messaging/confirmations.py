"""Confirms stored messages to agents that use MQTT, which repeat acks, events and late measurements until then."""

from collections import defaultdict
from collections.abc import Iterable

from device_agent.protocol import Stored, codec, topics
from device_agent.protocol.acks import MAX_IDS, message_id
from device_agent.protocol.errors import ProtocolError
from function_app.services.messaging.broker_relay import BrokerRelay


class Confirmations:
    """Publishes confirmations, best effort: a lost one only causes one repetition."""

    def __init__(self, *, relay: BrokerRelay) -> None:
        self._relay = relay

    async def publish(self, messages: Iterable[tuple[str, bytes]]) -> None:
        """Confirm received messages that are stored, or that will never be accepted. Never raises.

        Args:
            messages: Topics and exact payloads; those of other classes are ignored.
        """
        ids: defaultdict[str, list[str]] = defaultdict(list)
        for topic, payload in messages:
            try:
                parsed = topics.parse(topic)
            except ProtocolError:
                continue  # not a topic of an agent
            if parsed.kind in topics.CONFIRMED:
                answer = topics.device(parsed.space, parsed.agent, parsed.device, topics.STORED)
                ids[answer].append(message_id(topic, payload))
        await self._relay.publish(
            (topic, topics.parse(topic), codec.encode(Stored(ids=tuple(stored[first : first + MAX_IDS]))))
            for topic, stored in ids.items()
            for first in range(0, len(stored), MAX_IDS)
        )
