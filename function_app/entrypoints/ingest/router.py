"""Stores messages of agents and devices. All transports and hosts use these functions."""

import logging
from collections.abc import Sequence

from device_agent.protocol import Ack, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.fields import trace_id
from device_agent.protocol.security import log_output
from device_agent.protocol.topics import Topic
from function_app.bootstrap import Functions
from function_app.domain.common.ids import device_id
from function_app.domain.devices.devices import Transport
from function_app.ports.monitoring import Counter
from function_app.services.telemetry.ingest import InboundMessage

_MAX_LOGGED = 200

_log = logging.getLogger(__name__)


async def ingest(functions: Functions, topic: str, payload: bytes) -> None:
    """Store one MQTT message. Safe to repeat. An invalid message is logged and dropped.

    Raises:
        Problem, StoreError: The message is not stored; it must be delivered again.
    """
    try:
        parsed = topics.parse(topic)
        log_output.context.set(lambda: _log_context(parsed, payload))
        if not functions.heartbeats.observe(parsed, payload):
            await store_message(functions, parsed, payload)
            functions.metrics.count(Counter.MESSAGES, parsed.kind)
    except ProtocolError as error:
        _log.warning("dropped a message on %s: %s", topic[:_MAX_LOGGED], error)


def _log_context(topic: Topic, payload: bytes) -> dict[str, str]:
    device = device_id(topic.agent, topic.device) if topic.device else ""
    if topic.kind != topics.ACK:
        return {"device": device}
    ack = codec.decode(payload, Ack)
    return {"device": device, "action": ack.id, "trace_id": trace_id(ack.traceparent)}


async def store_message(functions: Functions, topic: Topic, payload: bytes, *, by: Transport = "mqtt") -> None:
    """Store one message of any transport. Safe to repeat.

    Raises:
        ProtocolError: The payload does not match its topic.
        Problem, StoreError: The message is not stored; it must be delivered again.
    """
    if topic.kind == topics.ACK:
        await functions.action_acks.ingest(topic, payload, by=by)
    elif topic.kind in topics.MEASURED:
        await functions.telemetry_ingest.ingest([InboundMessage(topic, payload)])
    elif topic.kind in {topics.CONN, topics.DESC, topics.STATE, topics.EVENT}:
        await functions.presence.ingest(topic, payload, by=by)


def is_telemetry(topic: str) -> bool:
    """Whether the topic is one of telemetry, which ``ingest_telemetry`` stores in batches."""
    return any(f"/{kind}/" in topic for kind in topics.MEASURED)


async def ingest_telemetry(functions: Functions, messages: Sequence[tuple[str, bytes]]) -> None:
    """Store a batch of telemetry, which is much cheaper than single messages. Safe to repeat.

    Raises:
        Problem, StoreError: At least one message is not stored; all must be delivered again.
    """
    batch = []
    for topic, payload in messages:
        try:
            parsed = topics.parse(topic)
        except ProtocolError as error:
            _log.warning("%s", error)
            continue
        if parsed.kind in topics.MEASURED:
            batch.append(InboundMessage(parsed, payload))
    if batch:
        await functions.telemetry_ingest.ingest(batch)
        functions.metrics.count(Counter.MESSAGES, batch[0].topic.kind, by=len(batch))
