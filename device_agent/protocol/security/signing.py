"""Signatures on what the cloud tells a robot: Ed25519 over the exact bytes that travel.

The signed text is carried as raw JSON inside an envelope, so nothing depends on two programs writing the same JSON
for the same value. A context string keeps a signature made for one purpose from serving another.
"""

import base64
import binascii
import hashlib
from collections.abc import Mapping

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from msgspec import Raw, Struct

from device_agent.protocol import codec
from device_agent.protocol.errors import ProtocolError, SignatureError

COMMAND_CONTEXT = b"telescope/v1/command\n"
MOVEMENT_CONTEXT = b"telescope/v1/movement\n"


class Signed(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``cmd`` on the wire: ``body`` is a ``Command``, ``key`` names the public key, ``signature`` is base64url."""

    key: str
    signature: str
    body: Raw


def generate() -> Ed25519PrivateKey:
    """A new private key."""
    return Ed25519PrivateKey.generate()


def public_text(key: Ed25519PublicKey) -> str:
    """The public key as base64url text: the form in which it is stored, sent and pinned."""
    raw = key.public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw)
    return base64.urlsafe_b64encode(raw).rstrip(b"=").decode()


def public_key(text: str) -> Ed25519PublicKey:
    """Read what ``public_text`` wrote.

    Raises:
        ProtocolError: Not 32 bytes of base64url.
    """
    try:
        return Ed25519PublicKey.from_public_bytes(_unbase64(text))
    except (ValueError, binascii.Error) as error:
        raise ProtocolError("not an Ed25519 public key in base64url (43 characters)") from error


def key_id(key: Ed25519PublicKey) -> str:
    """A short stable name of a public key."""
    return hashlib.sha256(public_text(key).encode()).hexdigest()[:16]


def sign(body: bytes, key: Ed25519PrivateKey, *, context: bytes = COMMAND_CONTEXT) -> bytes:
    """The envelope around ``body`` (JSON), ready to publish."""
    signature = base64.urlsafe_b64encode(key.sign(context + body)).rstrip(b"=").decode()
    return codec.encode(Signed(key=key_id(key.public_key()), signature=signature, body=Raw(body)))


def verify(payload: bytes, keys: Mapping[str, Ed25519PublicKey], *, context: bytes = COMMAND_CONTEXT) -> bytes:
    """The body of an envelope, once one of the pinned ``keys`` (by ``key_id``) is seen to have signed it.

    Raises:
        SignatureError: Unknown key, or not signed by it.
        ProtocolError: Not an envelope.
    """
    envelope = codec.decode(payload, Signed)
    key = keys.get(envelope.key)
    if key is None:
        raise SignatureError(f"signed with key '{envelope.key[:32]}', which this device has not pinned")
    body = bytes(envelope.body)
    try:
        key.verify(_unbase64(envelope.signature), context + body)
    except (InvalidSignature, ValueError, binascii.Error) as error:
        raise SignatureError("the signature does not match the message") from error
    return body


def movement_text(robot_type: str, name: str, version: int, sha256: str) -> str:
    """What the signature of a movement's version says: four lines, none of which can hold a line's end."""
    return f"{robot_type}\n{name}\n{version}\n{sha256}"


def sign_text(text: str, key: Ed25519PrivateKey, *, context: bytes) -> str:
    """A signature that is kept beside ``text``, as base64url."""
    return base64.urlsafe_b64encode(key.sign(context + text.encode())).rstrip(b"=").decode()


def verify_text(text: str, signature: str, key: Ed25519PublicKey, *, context: bytes) -> None:
    """Check what ``sign_text`` made.

    Raises:
        SignatureError: ``key`` did not sign this text for this purpose.
    """
    try:
        key.verify(_unbase64(signature), context + text.encode())
    except (InvalidSignature, ValueError, binascii.Error) as error:
        raise SignatureError("the signature does not match the text") from error


def _unbase64(text: str) -> bytes:
    """Bytes of base64url; each has one text alone, so that no character of it may differ."""
    content = base64.b64decode(text + "=" * (-len(text) % 4), altchars=b"-_", validate=True)
    if base64.urlsafe_b64encode(content).rstrip(b"=").decode() != text:
        raise binascii.Error("bits are set that belong to no byte")
    return content
