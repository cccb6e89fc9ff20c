"""What devices say, into the tables: the one handler behind every way in."""

import logging

from device_agent.protocol import topics
from device_agent.protocol.errors import ProtocolError
from function_app.bootstrap import Functions

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
    elif parsed.kind in {topics.CONN, topics.DESC, topics.STATE, topics.EVENT}:
        await functions.presence.ingest(parsed, payload)
