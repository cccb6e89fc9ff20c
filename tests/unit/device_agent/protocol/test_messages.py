import json
import math
from typing import Any

import jsonschema
import msgspec
import pytest

from device_agent.protocol import Command, JointTarget, JointTelemetry, Mode, MoveJoints, Setpoint, State, codec
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
MOVE = MoveJoints(position_rad={"elbow": 1.0})
COMMAND = Command(
    id="c1", space="s", agent="a", device="d", issued_at_ms=1, ttl_ms=1000, caller="ann", epoch=1, request=MOVE
)
BODY = codec.encode(COMMAND)
KEY = signing.generate()
KEYS = {signing.key_id(KEY.public_key()): KEY.public_key()}


def changed(**fields: Any) -> bytes:
    return json.dumps(SETPOINT | fields).encode()


def test_a_setpoint_is_parsed() -> None:
    assert codec.decode(changed(), Setpoint).target == JointTarget(position_rad={"elbow": 0.5})


@pytest.mark.parametrize(
    "payload",
    [
        *(b"", b"null", b"[]", b"\xff\xfe", b"{" * 100_000, b" " * (codec.MAX_BYTES + 1)),
        *(changed(epoch=epoch) for epoch in (-1, 1.0, "1", True)),
        *(changed(sequence=sequence) for sequence in (0, 2**60)),
        changed(target={"kind": "joints", "position_rad": {}}),
        changed(target={"kind": "teleport", "position_rad": {"elbow": 1}}),
        changed(target={"kind": "joints", "position_rad": {"elbow": None}}),
        *(changed(sent_ms=number) for number in (math.nan, math.inf)),
        *(changed().replace(b"0.5", number) for number in (b"1e999", b"-1e999", b"NaN", b"Infinity")),
    ],
)
def test_invalid_setpoints_are_rejected(payload: bytes) -> None:
    with pytest.raises(ProtocolError):
        codec.decode(payload, Setpoint)


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_only_finite_numbers_are_written(number: float) -> None:
    with pytest.raises(ProtocolError):
        codec.encode(MoveJoints(position_rad={"elbow": number}))


def test_unknown_fields_are_ignored_in_both_directions_and_at_every_level() -> None:
    state = {"device": "d", "at_ms": 1, "tick_ms": 1, "mode": "idle", "epoch": 0, "battery": 1}
    assert codec.decode(json.dumps(state).encode(), State).device == "d"
    command = msgspec.to_builtins(COMMAND)
    newer = {**command, "colour": "red", "request": {**command["request"], "mood": {"of": "a newer cloud"}}}
    assert codec.decode(json.dumps(newer).encode(), Command) == COMMAND
    target = {**SETPOINT["target"], "stiffness": 1}
    assert codec.decode(changed(target=target, extra=1), Setpoint) == codec.decode(changed(), Setpoint)
    envelope = json.loads(signing.sign(BODY, KEY)) | {"hint": 1}
    assert signing.verify(json.dumps(envelope, separators=(",", ":")).encode(), KEYS) == BODY


def test_an_unknown_kind_of_request_is_rejected() -> None:
    command = {**msgspec.to_builtins(COMMAND), "request": {"kind": "juggle", "balls": 3}}
    with pytest.raises(ProtocolError, match="juggle"):
        codec.decode(json.dumps(command).encode(), Command)


def test_a_signed_command_is_verified_with_the_pinned_key() -> None:
    assert codec.decode(signing.verify(signing.sign(BODY, KEY), KEYS), Command) == COMMAND


def test_a_change_of_any_byte_of_a_signed_command_is_rejected() -> None:
    payload = signing.sign(BODY, KEY)
    accepted = []
    for index in range(len(payload)):
        forged = bytearray(payload)
        forged[index] ^= 1
        try:
            accepted.append(signing.verify(bytes(forged), KEYS))
        except ProtocolError:
            continue
    assert accepted in ([], [BODY]), "only the last bits of the base64 padding carry nothing"


def test_another_key_another_purpose_and_no_key_are_rejected() -> None:
    for payload, keys in (
        (signing.sign(BODY, signing.generate()), KEYS),
        (signing.sign(BODY, KEY, context=b"other\n"), KEYS),
        (signing.sign(BODY, KEY), {}),
    ):
        with pytest.raises(SignatureError):
            signing.verify(payload, keys)


def test_public_keys_are_written_and_parsed() -> None:
    text = signing.public_text(KEY.public_key())
    assert signing.public_text(signing.public_key(text)) == text
    for invalid in ("", "x", "A" * 44, "ä" * 43):
        with pytest.raises(ProtocolError):
            signing.public_key(invalid)


def test_the_asyncapi_document_describes_what_the_code_parses() -> None:
    schema = {"$ref": "#/components/schemas/Setpoint", "components": asyncapi.document()["components"]}
    jsonschema.validate(SETPOINT, schema)
    for fields in ({"epoch": -1}, {"target": {"kind": "joints", "position_rad": {}}}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(SETPOINT | fields, schema)


def test_every_reference_in_the_asyncapi_document_resolves() -> None:
    document = asyncapi.document()

    def references(node: Any) -> list[str]:
        children = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
        own = [node["$ref"]] if isinstance(node, dict) and isinstance(node.get("$ref"), str) else []
        return own + [reference for child in children for reference in references(child)]

    assert references(document)
    for reference in references(document):
        node: Any = document
        for part in reference.removeprefix("#/").split("/"):
            node = node[part]


def test_telemetry_of_a_six_joint_arm_is_small() -> None:
    six = (1.234567,) * 6
    telemetry = JointTelemetry(
        tick_ms=10**9, at_ms=2 * 10**12, sequence=10**6, mode=Mode.STREAMING,
        position_rad=six, velocity_rad_s=six, effort_nm=six, commanded_rad=six, frames=((1.234567,) * 7,) * 7,
    )  # fmt: skip
    assert len(codec.encode(telemetry)) < 1200
