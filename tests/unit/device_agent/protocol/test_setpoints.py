"""Authentication of setpoints."""

import unicodedata

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from device_agent.protocol import GrantLease, Stop, codec, fields
from device_agent.protocol.errors import ProtocolError, SignatureError
from device_agent.protocol.security import setpoints, signing
from device_agent.protocol.security.setpoints import SetpointKey

AGENT, CLOUD = signing.generate(), signing.generate()
TOPIC = "ts/v1/s/a/arm/ctl/7"


def key(*, topic: str = TOPIC, pairing: str = "p") -> bytes:
    return setpoints.lease_key(CLOUD, AGENT.public_key(), topic=topic, pairing=pairing)


def test_agent_and_cloud_derive_the_same_key_for_one_lease_only() -> None:
    assert setpoints.lease_key(AGENT, CLOUD.public_key(), topic=TOPIC, pairing="p") == key()
    others = (key(topic="ts/v1/s/a/arm/ctl/8"), key(topic="ts/v1/s/b/arm/ctl/7"), key(pairing="q"))
    assert len({key(), *others, setpoints.lease_key(AGENT, AGENT.public_key(), topic=TOPIC, pairing="p")}) == 5


def test_a_public_key_of_small_order_is_rejected() -> None:
    identity = Ed25519PublicKey.from_public_bytes((1).to_bytes(32, "little"))
    with pytest.raises(ProtocolError, match="key agreement"):
        setpoints.lease_key(CLOUD, identity, topic=TOPIC, pairing="p")


def test_a_sealed_body_is_opened_with_its_key_and_topic_only() -> None:
    sealed = setpoints.seal(b'{"a": 1}', key(), TOPIC)
    other, right = SetpointKey(b"other", TOPIC), SetpointKey(key(), TOPIC)
    for _ in range(2):  # a key can be used again
        assert setpoints.open_sealed(sealed, (other, right)) == b'{"a": 1}'
    for keys in ((), (other,), (SetpointKey(key(), "ts/v1/s/a/arm/ctl/8"),)):
        with pytest.raises(SignatureError):
            setpoints.open_sealed(sealed, keys)


def test_a_tag_has_the_documented_value() -> None:
    """The same vector is tested in the console."""
    sealed = setpoints.seal(b'{"epoch":7}', bytes(range(32)), TOPIC)
    assert sealed == b'{"tag":"8cee6c4b32a7876f9bf1463a3792121a","body":{"epoch":7}}'


@pytest.mark.parametrize("text", ["a\nb", "a\x1b[31m", "a\u202eb", "a\u200bb", "a\U000e0041b", "a\u2028b"])
def test_a_label_contains_no_control_or_format_character(text: str) -> None:
    payload = codec.encode({"kind": "grant_lease", "holder": text, "lease_ms": 1000})
    with pytest.raises(ProtocolError):
        codec.decode(payload, GrantLease)
    clean = codec.encode({"kind": "grant_lease", "holder": fields.printable(text), "lease_ms": 1000})
    assert codec.decode(clean, GrantLease).holder == "a\ufffd" + text[2:]


def test_unprintable_characters_include_the_unicode_categories_cc_cf_zl_and_zp() -> None:
    kinds = {"Cc", "Cf", "Zl", "Zp"}
    listed = [chr(code) for code in range(0x110000) if unicodedata.category(chr(code)) in kinds]
    assert fields.printable("".join(listed)) == "\ufffd" * len(listed)


def test_an_unknown_field_does_not_prevent_a_stop() -> None:
    assert codec.decode(b'{"id":"s1","caller":"an older console"}', Stop) == Stop(id="s1")
