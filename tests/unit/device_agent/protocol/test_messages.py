import copy
import json
import math
from typing import Any

import jsonschema
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from device_agent.protocol import Command, JointTarget, JointTelemetry, MoveJoints, Setpoint, State, codec
from device_agent.protocol.documents import asyncapi
from device_agent.protocol.errors import ProtocolError, SignatureError
from device_agent.protocol.security import signing

SETPOINT: dict[str, Any] = {
    "epoch": 3,
    "sequence": 1,
    "echo_tick_ms": 5,
    "sent_ms": 1.5,
    "target": {"kind": "joints", "position_rad": {"elbow": 0.5}},
}


def command() -> Command:
    return Command(
        id="c1",
        space="s",
        agent="a",
        device="d",
        issued_at_ms=1,
        ttl_ms=1000,
        caller="ann",
        epoch=1,
        request=MoveJoints(position_rad={"elbow": 1.0}),
    )


def changed(**fields: Any) -> bytes:
    return json.dumps(SETPOINT | fields).encode()


def test_a_setpoint_is_read() -> None:
    assert codec.decode(changed(), Setpoint).target == JointTarget(position_rad={"elbow": 0.5})


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"null",
        b"[]",
        b"\xff\xfe",
        b"{" * 100_000,
        changed(epoch=-1),
        changed(epoch=1.0),
        changed(epoch="1"),
        changed(epoch=True),
        changed(sequence=0),
        changed(sequence=2**60),
        changed(extra=1),
        changed(target={"kind": "joints", "position_rad": {}}),
        changed(target={"kind": "teleport", "position_rad": {"elbow": 1}}),
        changed(target={"kind": "joints", "position_rad": {"elbow": None}}),
        changed(sent_ms=math.nan),
        changed(sent_ms=math.inf),
        changed().replace(b"0.5", b"1e999"),
        changed().replace(b"0.5", b"-1e999"),
        changed().replace(b"0.5", b"NaN"),
        changed().replace(b"0.5", b"Infinity"),
        b" " * (codec.MAX_BYTES + 1),
    ],
)
def test_what_is_no_setpoint_is_refused(payload: bytes) -> None:
    with pytest.raises(ProtocolError):
        codec.decode(payload, Setpoint)


@given(st.binary(max_size=300))
def test_no_bytes_raise_anything_else(payload: bytes) -> None:
    for kind in (Setpoint, Command, State, signing.Signed):
        try:
            codec.decode(payload, kind)
        except ProtocolError:
            continue


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_never_written(bad: float) -> None:
    with pytest.raises(ProtocolError):
        codec.encode(MoveJoints(position_rad={"elbow": bad}))


def test_a_robot_may_say_more_than_an_old_page_knows_but_may_not_be_told_more() -> None:
    state = {"device": "d", "at_ms": 1, "tick_ms": 1, "mode": "idle", "epoch": 0}
    assert codec.decode(json.dumps(state | {"battery": 1}).encode(), State).device == "d"
    order = msgspec.to_builtins(command()) | {"colour": "red"}
    with pytest.raises(ProtocolError):
        codec.decode(json.dumps(order).encode(), Command)


# ------------------------------------------------------------ signatures


def test_a_signed_command_is_read_with_the_pinned_key() -> None:
    key = signing.generate()
    keys = {signing.key_id(key.public_key()): key.public_key()}
    payload = signing.sign(codec.encode(command()), key)
    assert codec.decode(signing.verify(payload, keys), Command) == command()


def test_each_byte_of_a_signed_command_counts() -> None:
    key = signing.generate()
    keys = {signing.key_id(key.public_key()): key.public_key()}
    payload = signing.sign(codec.encode(command()), key)
    passed = 0
    for index in range(len(payload)):
        forged = bytearray(payload)
        forged[index] ^= 1
        try:
            body = signing.verify(bytes(forged), keys)
        except ProtocolError:
            continue
        passed += 1
        assert body == codec.encode(command())  # at most the last bits of base64 padding, which carry nothing
    assert passed <= 1


def test_another_key_another_purpose_and_no_key_are_refused() -> None:
    key, other = signing.generate(), signing.generate()
    keys = {signing.key_id(key.public_key()): key.public_key()}
    body = codec.encode(command())
    for payload in (signing.sign(body, other), signing.sign(body, key, context=b"other\n")):
        with pytest.raises(SignatureError):
            signing.verify(payload, keys)
    with pytest.raises(SignatureError):
        signing.verify(signing.sign(body, key), {})


def test_a_public_key_survives_as_text() -> None:
    key = signing.generate().public_key()
    assert signing.public_text(signing.public_key(signing.public_text(key))) == signing.public_text(key)
    for text in ("", "x", "A" * 44, "ä" * 43):
        with pytest.raises(ProtocolError):
            signing.public_key(text)


# ------------------------------------------------------------ the published document


def test_the_document_describes_what_the_code_reads() -> None:
    published = asyncapi.document()
    schema = {"$ref": "#/components/schemas/Setpoint", "components": published["components"]}
    jsonschema.validate(SETPOINT, schema)
    for fields in ({"epoch": -1}, {"extra": 1}, {"target": {"kind": "joints", "position_rad": {}}}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(SETPOINT | fields, schema)


def test_every_reference_of_the_document_leads_somewhere() -> None:
    published = asyncapi.document()

    def references(node: Any) -> list[str]:
        if isinstance(node, dict):
            own = [node["$ref"]] if isinstance(node.get("$ref"), str) else []
            return own + [found for value in node.values() for found in references(value)]
        if isinstance(node, list):
            return [found for value in node for found in references(value)]
        return []

    found = references(published)
    assert found
    for reference in found:
        node = copy.copy(published)
        for part in reference.removeprefix("#/").split("/"):
            node = node[part]


def test_telemetry_of_a_six_joint_arm_is_small() -> None:
    six = (1.234567,) * 6
    telemetry = JointTelemetry(
        tick_ms=10**9,
        at_ms=2 * 10**12,
        sequence=10**6,
        mode="streaming",  # type: ignore[arg-type]
        position_rad=six,
        velocity_rad_s=six,
        effort_nm=six,
        commanded_rad=six,
        frames=((1.234567,) * 7,) * 7,
    )
    assert len(codec.encode(telemetry)) < 1200
