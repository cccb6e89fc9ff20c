"""Ed25519 of the wrapper for legacy robots: vectors of RFC 8032, agreement with ``cryptography``, malformed input."""

import ast
import hashlib
import json
import subprocess

import pytest
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from hypothesis import given, settings
from hypothesis import strategies as st

from device_agent.protocol.security import signing
from tests.harness.hosts.host import interpreter
from tests.unit.examples.legacy_cloud import WRAPPER, load_wrapper

legacy = load_wrapper()
ORDER: int = legacy.ORDER
FIELD = 2**255 - 19

RFC_8032 = [
    (
        "9d61b19deffd5a60ba844af492ec2cc44449c5697b326919703bac031cae7f60",
        "d75a980182b10ab7d54bfed3c964073a0ee172f3daa62325af021a68f707511a",
        "",
        (
            "e5564300c360ac729086e2cc806e828a84877f1eb8e5d974d873e06522490155"
            "5fb8821590a33bacc61e39701cf9b46bd25bf5f0595bbe24655141438e7a100b"
        ),
    ),
    (
        "4ccd089b28ff96da9db6c346ec114e0f5b8a319f35aba624da8cf6ed4fb8a6fb",
        "3d4017c3e843895a92b70aa74d1b7ebc9c982ccf2ec4968cc0cd55f12af4660c",
        "72",
        (
            "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da"
            "085ac1e43e15996e458f3613d0f11d8c387b2eaeb4302aeeb00d291612bb0c00"
        ),
    ),
    (
        "c5aa8df43f9f837bedb7442f31dcb7b166d38535076f094b85ce3a2e0b4458f7",
        "fc51cd8e6218a1a38da47ed00230f0580816ed13ba3303ac5deb911548908025",
        "af82",
        (
            "6291d657deec24024827e69c3abe01a30ce548a284743a445e3680d7db5ac3ac"
            "18ff9b538d16f290ae67f760984dc6594a7c15e9716ed28dc027beceea1ec40a"
        ),
    ),
    (
        "833fe62409237b9d62ec77587520911e9a759cec1d19755b7da901b96dca3d42",
        "ec172b93ad5e563bf4932c70e1245034c35467ef2efd4d64ebf819683467e2bf",
        hashlib.sha512(b"abc").hexdigest(),
        (
            "dc2a4459e7369633a52b1bf277839a00201009a3efbf3ecb69bea2186c26b589"
            "09351fc9ac90b3ecfdfbc7c66431e0303dca179c138ac17ad9bef1177331a704"
        ),
    ),
]
"""Private key, public key, message and signature of section 7.1."""
SMALL_ORDER = [
    "0100000000000000000000000000000000000000000000000000000000000000",
    "ecffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff7f",
    "0000000000000000000000000000000000000000000000000000000000000000",
    "0000000000000000000000000000000000000000000000000000000000000080",
    "26e8958fc2b227b045c3f489f2ef98f0d5dfac05d3c63339b13802886d53fc05",
    "26e8958fc2b227b045c3f489f2ef98f0d5dfac05d3c63339b13802886d53fc85",
    "c7176a703d4dd84fba3c0b760d10670f2a2053fa2c39ccc64ec7fd7792ac037a",
    "c7176a703d4dd84fba3c0b760d10670f2a2053fa2c39ccc64ec7fd7792ac03fa",
]
"""The canonical encodings of all points of small order."""
OTHER_ENCODINGS = [
    (FIELD + 1).to_bytes(32, "little"),
    (1 | 1 << 255).to_bytes(32, "little"),
    (FIELD - 1 | 1 << 255).to_bytes(32, "little"),
    (2**255 - 1).to_bytes(32, "little"),
]
"""Encodings of points that RFC 8032 does not allow."""
PRIVATE, PUBLIC, MESSAGE, SIGNATURE = (bytes.fromhex(text) for text in RFC_8032[2])
seeds = st.binary(min_size=32, max_size=32)


def accepted_by_library(public: bytes, message: bytes, signature: bytes) -> bool:
    try:
        Ed25519PublicKey.from_public_bytes(public).verify(signature, message)
    except (InvalidSignature, ValueError):
        return False
    return True


@pytest.mark.parametrize("vector", RFC_8032)
def test_the_vectors_of_the_rfc_are_reproduced(vector: tuple[str, ...]) -> None:
    private, public, message, signature = (bytes.fromhex(text) for text in vector)
    assert legacy.public_key(private) == public
    assert legacy.sign(private, public, message) == signature
    assert legacy.verify(public, message, signature)
    assert not legacy.verify(public, message + b"x", signature)


@settings(max_examples=20)
@given(seeds, st.binary(max_size=200))
def test_signatures_equal_those_of_the_library(seed: bytes, message: bytes) -> None:
    library = Ed25519PrivateKey.from_private_bytes(seed)
    public = library.public_key().public_bytes_raw()
    assert legacy.public_key(seed) == public
    assert legacy.sign(seed, public, message) == library.sign(message)


@settings(max_examples=40)
@given(st.integers(0, 8 * 96 - 1))
def test_a_signature_or_key_with_one_changed_bit_is_rejected(bit: int) -> None:
    changed = bytearray(PUBLIC + SIGNATURE)
    changed[bit // 8] ^= 1 << bit % 8
    public, signature = bytes(changed[:32]), bytes(changed[32:])
    assert not legacy.verify(public, MESSAGE, signature)
    assert not accepted_by_library(public, MESSAGE, signature)


def test_a_second_scalar_for_the_same_signature_is_rejected() -> None:
    scalar = int.from_bytes(SIGNATURE[32:], "little")
    for multiple in range(1, 2**256 // ORDER):
        other = (scalar + multiple * ORDER).to_bytes(32, "little")
        assert not legacy.verify(PUBLIC, MESSAGE, SIGNATURE[:32] + other)


@pytest.mark.parametrize("signature", [b"", SIGNATURE[:63], SIGNATURE + b"\0", SIGNATURE[:32], bytes(64)])
def test_signatures_of_another_length_or_without_content_are_rejected(signature: bytes) -> None:
    assert not legacy.verify(PUBLIC, MESSAGE, signature)


@pytest.mark.parametrize("public", [*map(bytes.fromhex, SMALL_ORDER), *OTHER_ENCODINGS, PUBLIC[:31], PUBLIC + b"\0"])
def test_keys_of_small_order_and_other_encodings_verify_nothing(public: bytes) -> None:
    # With a key of small order the first signature would be valid for many messages.
    for signature in (bytes.fromhex(SMALL_ORDER[0]) + bytes(32), SIGNATURE, bytes(64)):
        assert not any(legacy.verify(public, bytes([message]), signature) for message in range(2))


def test_each_point_has_one_encoding() -> None:
    on_curve = [y for y in range(19) if legacy._decode(y.to_bytes(32, "little")) is not None]
    assert len(on_curve) > 5
    for y in on_curve:
        assert legacy._decode((y + FIELD).to_bytes(32, "little")) is None


def test_a_key_of_small_order_would_otherwise_verify_a_forged_message() -> None:
    signature = bytes.fromhex(SMALL_ORDER[0]) + bytes(32)
    assert any(accepted_by_library(bytes.fromhex(SMALL_ORDER[0]), bytes([message]), signature) for message in range(2))


def test_a_commitment_in_another_encoding_is_rejected() -> None:
    for first in (*map(bytes.fromhex, SMALL_ORDER), *OTHER_ENCODINGS):
        assert not legacy.verify(PUBLIC, MESSAGE, first + SIGNATURE[32:])


def test_the_grammar_is_that_of_python_3_6() -> None:
    """Also on a machine without this version."""
    ast.parse(WRAPPER.read_text(encoding="utf-8"), feature_version=(3, 6))


@pytest.mark.parametrize("version", ["3.6", "3.13"])
def test_other_versions_of_python_agree(version: str) -> None:
    python = interpreter(version)
    program = (
        "import json, sys\nsys.path.insert(0, sys.argv[1])\nimport telescope_legacy as legacy\n"
        "for line in json.load(sys.stdin):\n"
        "    private, public, message, signature = map(bytes.fromhex, line)\n"
        "    assert legacy.public_key(private) == public\n"
        "    assert legacy.sign(private, public, message) == signature\n"
        "    assert legacy.verify(public, message, signature)\n"
        "    assert not legacy.verify(public, message + b'x', signature)\n"
    )
    command = [python, "-I", "-B", "-c", program, str(WRAPPER.parent)]
    subprocess.run(command, input=json.dumps(RFC_8032), text=True, check=True)


# ---------------------------------------------------------------- the envelope

KEY = Ed25519PrivateKey.from_private_bytes(PRIVATE)
KEYS = {signing.key_id(KEY.public_key()): signing.public_text(KEY.public_key())}
BODY = '{"id": "a-1", "note": "\\u00e9 é", "list": [1, {"body": 2}]}'


def parse(payload: str, context: bytes = signing.COMMAND_CONTEXT) -> str:
    """The outcome: ``valid``, or the code of the rejection."""
    try:
        body = legacy.parse_envelope(payload, KEYS, context)
    except legacy.Refused as refused:
        return str(refused.code)
    assert body == json.loads(BODY)
    return "valid"


def envelope(**changes: str) -> str:
    signed = json.loads(signing.sign(BODY.encode(), KEY))
    fields = {**signed, "body": BODY, **changes}
    return f'{{"key":"{fields["key"]}","signature":"{fields["signature"]}","body":{fields["body"]}}}'


def test_the_signature_covers_the_exact_text_of_the_body() -> None:
    assert parse(signing.sign(BODY.encode(), KEY).decode()) == "valid"
    assert parse(envelope()) == "valid"
    assert parse("\n" + envelope().replace(",", " ,\t").replace(BODY.replace(",", " ,\t"), BODY)) == "valid"
    assert parse(envelope(body=BODY.replace(" ", ""))) == "bad_signature"
    assert parse(envelope(), context=b"telescope/v1/keys\n") == "bad_signature"
    assert parse(envelope(key="0" * 16)) == "bad_signature"


def test_an_envelope_in_another_form_is_malformed() -> None:
    signature = json.loads(envelope())["signature"]
    for payload in (
        "",
        "[]",
        "{}",
        "null",
        BODY,
        envelope()[:-1],
        envelope(signature=signature + "="),
        envelope(signature=signature[:-1] + "+"),
        envelope(body="NaN"),
        envelope().replace('"body":', '"body":1,"body":'),
        envelope().replace('"key":', '"key"='),
        envelope().replace(",", ";", 1),
        envelope(body="[" * 100_000),
        envelope().replace('"key":"', '"key":[], "other":"', 1),
    ):
        assert parse(payload) == "malformed", payload[:200]
