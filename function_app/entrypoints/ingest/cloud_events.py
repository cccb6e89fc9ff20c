"""Stores device messages from Event Grid events, AWS IoT rules, and SQS queues behind these rules.

If a message cannot be stored, an exception makes the cloud deliver it again. An invalid message is logged and dropped.
Stored and dropped messages are confirmed to their agents.
All sources deliver at least once and in any order; ``ingest`` is idempotent and independent of the order.
"""

import base64
import binascii
import json
import logging
from collections.abc import Mapping, Sequence
from typing import Any

from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem
from function_app.entrypoints.ingest.router import ingest, ingest_telemetry, is_telemetry
from function_app.ports.tables import StoreError

RULE_SQL = "SELECT encode(*, 'base64') AS payload, topic() AS topic, timestamp() AS at_ms FROM 'ts/v1/#'"
"""The SQL of the IoT rule that sends these events."""
_MQTT = "MQTT.EventPublished"
_MAX_LOGGED = 200

_log = logging.getLogger(__name__)


async def from_event_grid(functions: Functions, events: Sequence[Mapping[str, Any]]) -> None:
    """Store MQTT messages that an Event Grid namespace routes as CloudEvents 1.0.

    The topic is the event's ``subject``. The payload is in ``data_base64``, or in ``data`` if the publisher declared it
    as JSON. The latter has lost its exact bytes, so its confirmation has no effect; agents declare no content type.

    Raises:
        Problem, StoreError: At least one message is not stored; all must be delivered again.
    """
    failed: Problem | StoreError | None = None
    telemetry: list[tuple[str, bytes]] = []
    stored: list[tuple[str, bytes]] = []
    for event in events:
        if event.get("type") != _MQTT:
            _log.warning("ignored an event of type '%s'", str(event.get("type"))[:_MAX_LOGGED])
            continue
        payload = _cloud_event_payload(event)
        if payload is None:
            _log.warning("dropped an event on '%s' without a valid payload", str(event.get("subject"))[:_MAX_LOGGED])
            continue
        topic = str(event.get("subject"))
        if is_telemetry(topic):
            telemetry.append((topic, payload))
            continue
        try:
            await ingest(functions, topic, payload)
            stored.append((topic, payload))
        except (Problem, StoreError) as error:
            failed = error
    try:
        await ingest_telemetry(functions, telemetry)
        stored += telemetry
    except (Problem, StoreError) as error:
        failed = error
    await functions.confirmations.publish(stored)
    if failed is not None:
        raise failed


async def from_iot_rule(functions: Functions, event: Mapping[str, Any]) -> None:
    """Store one MQTT message from the IoT rule with ``RULE_SQL``.

    Raises:
        Problem, StoreError: The message is not stored; it must be delivered again.
    """
    message = _rule_message(event)
    if message is not None:
        await ingest(functions, *message)
        await functions.confirmations.publish([message])


async def from_queue(functions: Functions, event: Mapping[str, Any]) -> dict[str, list[dict[str, str]]]:
    """Store a batch of messages that the rule has sent to an SQS queue.

    Returns:
        The records that were not stored, as a partial batch response: Lambda keeps only these in the queue.
    """
    failed: list[str] = []
    telemetry: dict[str, tuple[str, bytes]] = {}
    stored: list[tuple[str, bytes]] = []
    for record in event.get("Records", ()):
        message = _rule_message(_body(record))
        if message is None:
            continue
        if is_telemetry(message[0]):
            telemetry[str(record["messageId"])] = message
            continue
        try:
            await ingest(functions, *message)
            stored.append(message)
        except (Problem, StoreError) as error:
            _log.warning("record %s was not stored: %s", record.get("messageId"), error)
            failed.append(str(record["messageId"]))
    try:
        await ingest_telemetry(functions, list(telemetry.values()))
        stored += telemetry.values()
    except (Problem, StoreError) as error:
        _log.warning("%d telemetry records were not stored: %s", len(telemetry), error)
        failed += telemetry
    await functions.confirmations.publish(stored)
    return {"batchItemFailures": [{"itemIdentifier": record} for record in failed]}


def _rule_message(event: Mapping[str, Any]) -> tuple[str, bytes] | None:
    topic, payload = event.get("topic"), _base64(event.get("payload"))
    if not isinstance(topic, str) or payload is None:
        _log.warning("dropped an invalid event of the IoT rule with the fields %s", str(sorted(event))[:_MAX_LOGGED])
        return None
    return topic, payload


def _cloud_event_payload(event: Mapping[str, Any]) -> bytes | None:
    if "data_base64" in event:
        return _base64(event["data_base64"])
    data = event.get("data")
    if data is None:
        return None
    return data.encode() if isinstance(data, str) else json.dumps(data).encode()


def _base64(text: Any) -> bytes | None:
    if not isinstance(text, str):
        return None
    try:
        return base64.b64decode(text, validate=True)
    except (ValueError, binascii.Error):
        return None


def _body(record: Mapping[str, Any]) -> Mapping[str, Any]:
    try:
        body = json.loads(record["body"])
    except (KeyError, TypeError, ValueError, RecursionError):
        return {}
    return body if isinstance(body, dict) else {}
