"""What devices say, into the tables: the one handler behind every way in."""

import logging
from collections.abc import Sequence

from device_agent.protocol import topics
from device_agent.protocol.errors import ProtocolError
from function_app.bootstrap import Functions
from function_app.services.intake import Arrived

_log = logging.getLogger(__name__)


async def ingest(functions: Functions, topic: str, payload: bytes) -> None:
    """Store one message. Safe to repeat.

    Raises:
        Problem, StoreError: Not stored; to be delivered again.
    """
    try:
        parsed = topics.parse(topic)
    except ProtocolError as error:
        _log.warning("%s", error)
        return
    if parsed.kind == topics.ACK:
        await functions.action_acks.ingest(parsed, payload)
    elif parsed.kind == topics.TELE:
        await functions.intake.take([Arrived(parsed, payload)])
    elif parsed.kind in {topics.CONN, topics.DESC, topics.STATE, topics.EVENT}:
        await functions.presence.ingest(parsed, payload)


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
        if parsed.kind == topics.TELE:
            arrived.append(Arrived(parsed, payload))
    await functions.intake.take(arrived)
