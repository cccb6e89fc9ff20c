"""Valid seed examples. Those of JSON messages are derived from their types, so that new types are included."""

import json
from collections.abc import Iterator
from typing import Any

import msgspec
from msgspec import inspect

from device_agent import protocol
from device_agent.ports import script_calls
from device_agent.protocol.security.revocation import Control
from device_agent.protocol.security.setpoints import Tagged
from function_app.entrypoints import http  # noqa: F401 (defines all request bodies)
from function_app.entrypoints.http.framework.schemas import Request
from tests.harness.network import raw_mqtt

KINDS: tuple[Any, ...] = (
    protocol.Presence, protocol.Description, protocol.Twin, protocol.State, protocol.JointTelemetry,
    protocol.Measurements, protocol.Event, protocol.Ack, protocol.Command, protocol.Setpoint, protocol.Stop, Tagged,
    Control,
)  # fmt: skip
"""Types of the JSON messages of all topics."""
_DEEPEST = 4


def variants(kind: Any) -> Iterator[Any]:
    """Plain values of this type: each member of a union and each value of an enumeration once."""
    yield from _of(inspect.type_info(kind), 0)


def _of(kind: inspect.Type, depth: int) -> Iterator[Any]:  # noqa: C901, PLR0912 (one case for each type there is)
    match kind:
        case inspect.StructType(fields=fields, tag=tag, tag_field=tag_field):
            yield from _struct(fields, {tag_field: tag} if tag_field else {}, depth)
        case inspect.UnionType(types=types):
            for each in sorted(types, key=lambda each: isinstance(each, inspect.StructType))[
                : None if depth < _DEEPEST else 1
            ]:
                yield from _of(each, depth)
        case inspect.EnumType(cls=enum):
            yield from (member.value for member in enum)
        case inspect.LiteralType(values=values):
            yield from values
        case inspect.BoolType():
            yield from (True, False)
        case inspect.IntType(ge=least):
            yield least or 0
        case inspect.FloatType(ge=least, le=most, gt=above):
            yield max(least or 0.0, 1.0 if above is not None or most is None else 0.0)
        case inspect.StrType(pattern=pattern, min_length=shortest):
            yield "0" * 64 if pattern and "{64}" in pattern else "a" * max(1, shortest or 0)
        case inspect.Metadata(type=described):
            yield from _of(described, depth)
        case inspect.NoneType():
            yield None
        case inspect.DictType(key_type=key, value_type=value):
            for each in _of(value, depth + 1):
                yield {next(_of(key, depth + 1)): each}
        case inspect.VarTupleType(item_type=item) | inspect.ListType(item_type=item):
            yield [] if depth >= _DEEPEST else list(_of(item, depth + 1))[:3]
        case inspect.TupleType(item_types=items):
            yield [next(_of(item, depth + 1)) for item in items]
        case _:
            yield "anything"


def _struct(fields: tuple[inspect.Field, ...], tag: dict[str, Any], depth: int) -> Iterator[Any]:
    named = [field for field in fields if field.required or depth < _DEEPEST]
    choices = {field.encode_name: list(_of(field.type, depth + 1)) for field in named}
    whole = tag | {name: values[0] for name, values in choices.items()}
    yield whole
    yield tag | {field.encode_name: choices[field.encode_name][0] for field in named if field.required}
    for name, values in choices.items():
        for value in values[1:]:
            yield whole | {name: value}


def seeds(kinds: tuple[Any, ...]) -> tuple[bytes, ...]:
    """Examples of several types, each after a byte with the index of the type."""
    found = (
        bytes([number]) + json.dumps(value).encode() for number, kind in enumerate(kinds) for value in variants(kind)
    )
    return tuple(dict.fromkeys(found))


def _request_types(base: type[Any]) -> Iterator[type[Any]]:
    for kind in base.__subclasses__():
        yield from _request_types(kind)
        if not kind.__name__.startswith("_"):
            yield kind


MESSAGES = seeds(KINDS)
API_KINDS = tuple(sorted(set(_request_types(Request)), key=lambda kind: (kind.__module__, kind.__name__)))
"""Types of the API's request bodies."""
API_BODIES = seeds(API_KINDS)
BODIES = tuple(json.dumps(value).encode() for value in variants(protocol.Command))[:8]
LINES = tuple(json.dumps(value).encode() for value in variants(script_calls.Message))
TOPICS = tuple(
    pair.encode()
    for pair in (
        "ts/v1/+/+/conn ts/v1/s/a/conn", "ts/v1/s/a/+/ctl/+ ts/v1/s/a/arm/ctl/7", "ts/v1/s/# ts/v1/s/a/arm/desc/twin",
        "ts/v1/s/a/arm/cmd ts/v1/s/a/arm/cmd", "+/# $CONTROL/telescope/v1",
        "ts/v1/+/a/+/tele/joints ts/v1/s/a/d/tele/+",
    )
)  # fmt: skip
_ENROLLED = {"agent": "a", "claim_code": "AAAA-BBBB", "expires_in_s": 600.0, "state": "claimed", "keys": []}
_LETTER = {"items": [{"id": "c", "topic": "ts/v1/s/a/d/cmd", "payload": "{}"}]}
_RESULTS = {"results": [{"status": "stored"}, {"status": "rejected", "detail": "no"}]}
_PROBLEM = {"type": "/problems/agent-unclaimed", "title": "no", "detail": "not yours"}
_ACCESS = {
    "client_id": "a", "username": "u", "password": "p", "lifetime_s": 60, "subscribe": ["ts/v1/s/a/+/cmd"],
    "tcp": {"host": "127.0.0.1", "port": 1883}, "server_time_ms": 1, "jid": "a@site", "host": "h", "port": 5222,
}  # fmt: skip
RESPONSES = tuple(
    bytes([status, call]) + json.dumps(body).encode()
    for status, call, body in (
        (0, 0, _ENROLLED), (0, 1, _ENROLLED), (0, 2, _ACCESS), (0, 3, _LETTER), (0, 4, _RESULTS), (5, 3, _PROBLEM),
    )
)  # fmt: skip
_STANZA_ERRORS = "urn:ietf:params:xml:ns:xmpp-stanzas"
_RECEIPT = "<request xmlns='urn:xmpp:receipts'/>"
STANZAS = (
    f"<message from='a@site/b' id='7'><m xmlns='urn:telescope:v1' topic='t'>{{}}</m>{_RECEIPT}</message>".encode(),
    b"<message to='a@site'><m xmlns='urn:telescope:v1' topic='t' as='base64'>AAECAw==</m></message>",
    b"<message to='a@site'><received xmlns='urn:xmpp:receipts' id='7'/></message>",
    f"<message type='error' id='7'><error><text xmlns='{_STANZA_ERRORS}'>no</text></error></message>".encode(),
    b"<presence from='a@site/b'><priority>-1</priority></presence>",
)
HOMES = (
    b"""server = "http://127.0.0.1:8080"
name = "lab"
transport = "http"
allow_unconfined_scripts = false

[http]
poll = "plain"
poll_ms = 500

[[room]]
device = "x-pir"
stream = "motion"

[[devices]]
name = "arm"
type = "ur5"
driver = "mujoco"
label = "Arm"
[devices.options]
scene = "scene.xml"
""",
    b'server = "https://site"\nname = "lab"\n[[devices]]\nname = "arm"\ntype = "ur5"\n',
    json.dumps({"agent": "a", "space": "s", "account": "ann", "keys": {"k": "A" * 43}, "owner": "o"}).encode(),
)
PACKETS = (
    raw_mqtt.connect_packet("a", None),
    raw_mqtt.publish_packet("ts/v1/s/a/arm/ctl/7", b"{}", qos=1),
    raw_mqtt.publish_packet("ts/v1/s/a/arm/state", b"{}", retain=True),
    raw_mqtt.subscribe_packet("ts/v1/s/a/+/cmd", "ts/v1/s/a/+/stop/+", qos=1),
    raw_mqtt.PINGREQ,
    raw_mqtt.packet(4, b"\0\1"),
    raw_mqtt.packet(10, b"\0\1" + raw_mqtt.text("ts/v1/s/a/+/cmd"), 2),
)
assert msgspec.json.decode(BODIES[0], type=protocol.Command)
