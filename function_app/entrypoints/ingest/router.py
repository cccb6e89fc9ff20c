"""What devices say, into the tables: the one handler behind every way in."""

import logging
from collections.abc import Sequence

from device_agent.protocol import topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.topics import Topic
from function_app.bootstrap import Functions
from function_app.domain.devices.devices import Transport
from function_app.services.telemetry.ingest import InboundMessage

_SHOWN = 200

_log = logging.getLogger(__name__)


async def ingest(functions: Functions, topic: str, payload: bytes) -> None:
    """Store one message that came over MQTT. Safe to repeat; what cannot be read is logged and let go.

    Raises:
        Problem, StoreError: Not stored; to be delivered again.
    """
    try:
        await take_in(functions, topics.parse(topic), payload)
    except ProtocolError as error:
        _log.warning("a message of %s was dropped: %s", topic[:_SHOWN], error)


async def take_in(functions: Functions, topic: Topic, payload: bytes, *, by: Transport = "mqtt") -> None:
    """Store one message of any transport. Safe to repeat.

    Raises:
        ProtocolError: It is not what its topic says.
        Problem, StoreError: Not stored; to be delivered again.
    """
    if topic.kind == topics.ACK:
        await functions.action_acks.ingest(topic, payload, by=by)
    elif topic.kind in topics.MEASURED:
        await functions.telemetry_ingest.ingest([InboundMessage(topic, payload)])
    elif topic.kind in {topics.CONN, topics.DESC, topics.STATE, topics.EVENT}:
        await functions.presence.ingest(topic, payload, by=by)


def is_telemetry(topic: str) -> bool:
    """Whether it looks like a measurement's: those are better taken in together."""
    return any(f"/{kind}/" in topic for kind in topics.MEASURED)


async def ingest_telemetry(functions: Functions, messages: Sequence[tuple[str, bytes]]) -> None:
    """Store many measurements at once, which costs much less than one by one. Safe to repeat.

    Raises:
        Problem, StoreError: Not all are stored; to be delivered again.
    """
    arrived = []
    for topic, payload in messages:
        try:
            parsed = topics.parse(topic)
        except ProtocolError as error:
            _log.warning("%s", error)
            continue
        if parsed.kind in topics.MEASURED:
            arrived.append(InboundMessage(parsed, payload))
    if arrived:
        await functions.telemetry_ingest.ingest(arrived)
