"""Ed25519 signatures of messages from the cloud to devices, over the exact bytes in transit.

The envelope carries the signed text as raw JSON, so two programs need not produce equal JSON for equal values. A
context string prevents a signature made for one purpose from being used for another.
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


class Signed(Struct, frozen=True, kw_only=True):
    """``cmd`` on the wire: ``body`` is a ``Command``, ``key`` names the public key, ``signature`` is base64url."""

    key: str
    signature: str
    body: Raw


def generate() -> Ed25519PrivateKey:
    """Generate a private key."""
    return Ed25519PrivateKey.generate()


def public_text(key: Ed25519PublicKey) -> str:
    """The public key as base64url text, the form in which it is stored, sent and pinned."""
    raw = key.public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw)
    return base64.urlsafe_b64encode(raw).rstrip(b"=").decode()


def public_key(text: str) -> Ed25519PublicKey:
    """Parse the output of ``public_text``.

    Raises:
        ProtocolError: The text is not 32 bytes of base64url.
    """
    try:
        return Ed25519PublicKey.from_public_bytes(_unbase64(text))
    except (ValueError, binascii.Error) as error:
        raise ProtocolError("not an Ed25519 public key in base64url (43 characters)") from error


def key_id(key: Ed25519PublicKey) -> str:
    """Short, stable id of a public key."""
    return hashlib.sha256(public_text(key).encode()).hexdigest()[:16]


def sign(body: bytes, key: Ed25519PrivateKey, *, context: bytes = COMMAND_CONTEXT) -> bytes:
    """The signed envelope around ``body`` (JSON), ready to publish."""
    signature = base64.urlsafe_b64encode(key.sign(context + body)).rstrip(b"=").decode()
    return codec.encode(Signed(key=key_id(key.public_key()), signature=signature, body=Raw(body)))


def verify(payload: bytes, keys: Mapping[str, Ed25519PublicKey], *, context: bytes = COMMAND_CONTEXT) -> bytes:
    """The body of an envelope that one of ``keys`` has signed.

    Args:
        payload: The envelope.
        keys: Pinned keys by ``key_id``.
        context: Purpose of the signature.

    Raises:
        SignatureError: The key is unknown, or the signature does not match.
        ProtocolError: The payload is not an envelope.
    """
    envelope = codec.decode(payload, Signed)
    key = keys.get(envelope.key)
    if key is None:
        raise SignatureError(f"signed with key {envelope.key[:32]!r}, which this device has not pinned")
    body = bytes(envelope.body)
    try:
        key.verify(_unbase64(envelope.signature), context + body)
    except (InvalidSignature, ValueError, binascii.Error) as error:
        raise SignatureError("the signature does not match the message") from error
    return body


def movement_text(robot_type: str, name: str, version: int, sha256: str) -> str:
    """The text that the signature of a movement version covers: four lines; no field can contain a line break."""
    return f"{robot_type}\n{name}\n{version}\n{sha256}"


def sign_text(text: str, key: Ed25519PrivateKey, *, context: bytes) -> str:
    """A detached signature of ``text``, as base64url."""
    return base64.urlsafe_b64encode(key.sign(context + text.encode())).rstrip(b"=").decode()


def verify_text(text: str, signature: str, key: Ed25519PublicKey, *, context: bytes) -> None:
    """Verify a signature of ``sign_text``.

    Raises:
        SignatureError: ``key`` did not sign this text for this purpose.
    """
    try:
        key.verify(_unbase64(signature), context + text.encode())
    except (InvalidSignature, ValueError, binascii.Error) as error:
        raise SignatureError("the signature does not match the text") from error


def _unbase64(text: str) -> bytes:
    """Decode base64url strictly: each byte string has exactly one valid text, so signatures are not malleable."""
    content = base64.b64decode(text + "=" * (-len(text) % 4), altchars=b"-_", validate=True)
    if base64.urlsafe_b64encode(content).rstrip(b"=").decode() != text:
        raise binascii.Error("the text has unused bits set")
    return content
