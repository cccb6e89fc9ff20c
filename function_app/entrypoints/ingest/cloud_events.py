"""What devices say, as the clouds hand it over: Event Grid's events, Amazon's IoT rules, and queues behind those.

A message that cannot be stored raises, so that the cloud delivers it again. One that cannot be read never will be: it
is logged and let go. All deliver at least once and in any order, which ``ingest`` bears.
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
"""The SQL of the IoT rule whose events these are."""
_MQTT = "MQTT.EventPublished"
_SHOWN = 200

_log = logging.getLogger(__name__)


async def from_event_grid(functions: Functions, events: Sequence[Mapping[str, Any]]) -> None:
    """Take in MQTT messages that an Event Grid namespace has routed, as CloudEvents 1.0.

    The topic is the event's ``subject``; the payload is in ``data_base64``, or in ``data`` where its publisher called
    it JSON.

    Raises:
        Problem, StoreError: At least one was not stored; all are to be delivered again.
    """
    failed: Problem | StoreError | None = None
    measured: list[tuple[str, bytes]] = []
    for event in events:
        if event.get("type") != _MQTT:
            _log.warning("an event of type '%s' is no MQTT message", str(event.get("type"))[:_SHOWN])
            continue
        payload = _cloud_event_payload(event)
        if payload is None:
            _log.warning("the event of '%s' has no payload that can be read", str(event.get("subject"))[:_SHOWN])
            continue
        topic = str(event.get("subject"))
        if is_telemetry(topic):
            measured.append((topic, payload))
            continue
        try:
            await ingest(functions, topic, payload)
        except (Problem, StoreError) as error:
            failed = error
    try:
        await ingest_telemetry(functions, measured)
    except (Problem, StoreError) as error:
        failed = error
    if failed is not None:
        raise failed


async def from_iot_rule(functions: Functions, event: Mapping[str, Any]) -> None:
    """Take in one MQTT message, as the rule with ``RULE_SQL`` gives it.

    Raises:
        Problem, StoreError: Not stored; to be delivered again.
    """
    message = _rule_message(event)
    if message is not None:
        await ingest(functions, *message)


async def from_queue(functions: Functions, event: Mapping[str, Any]) -> dict[str, list[dict[str, str]]]:
    """Take in a batch of messages that the rule has put into a queue (SQS).

    Returns:
        The records that were not stored, in the form by which Lambda leaves only those in the queue.
    """
    failed: list[str] = []
    measured: dict[str, tuple[str, bytes]] = {}
    for record in event.get("Records", ()):
        message = _rule_message(_body(record))
        if message is None:
            continue
        if is_telemetry(message[0]):
            measured[str(record["messageId"])] = message
            continue
        try:
            await ingest(functions, *message)
        except (Problem, StoreError) as error:
            _log.warning("record %s was not stored: %s", record.get("messageId"), error)
            failed.append(str(record["messageId"]))
    try:
        await ingest_telemetry(functions, list(measured.values()))
    except (Problem, StoreError) as error:
        _log.warning("%d records of telemetry were not stored: %s", len(measured), error)
        failed += measured
    return {"batchItemFailures": [{"itemIdentifier": record} for record in failed]}


def _rule_message(event: Mapping[str, Any]) -> tuple[str, bytes] | None:
    topic, payload = event.get("topic"), _base64(event.get("payload"))
    if not isinstance(topic, str) or payload is None:
        _log.warning("an event with the fields %s is not what the rule gives", str(sorted(event))[:_SHOWN])
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
