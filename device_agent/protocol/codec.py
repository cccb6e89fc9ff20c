"""JSON on the wire, strict and finite.

NaN and infinities never pass: the decoder refuses the literals and numbers out of range, and the encoder refuses to
write them (``msgspec`` would silently write ``null``).
"""

import math
from typing import Any, TypeVar

import msgspec

from device_agent.protocol.errors import ProtocolError

MAX_BYTES = 128 * 1024
"""Largest message that AWS IoT Core takes (facts: brokers)."""
MAX_RETAINED_BYTES = 64 * 1024
"""Largest retained message that Event Grid takes."""

T = TypeVar("T")
_encoder = msgspec.json.Encoder()
_decoders: dict[Any, msgspec.json.Decoder[Any]] = {}


def encode(message: Any, *, limit: int = MAX_BYTES) -> bytes:
    """One message as JSON.

    Raises:
        ProtocolError: It holds a NaN or an infinity, or is longer than ``limit`` bytes.
    """
    payload = _encoder.encode(message)
    if b"null" in payload and not _finite(message):  # which is what it has made of such a number
        raise ProtocolError(f"{type(message).__name__} holds a number that is not finite")
    if len(payload) > limit:
        raise ProtocolError(f"{type(message).__name__} is {len(payload)} bytes, {limit} is the most")
    return payload


def decode(payload: bytes, kind: type[T]) -> T:
    """A message of the given type.

    Raises:
        ProtocolError: Not JSON, not this type, not finite, or longer than ``MAX_BYTES``; the text says which field.
    """
    if len(payload) > MAX_BYTES:
        raise ProtocolError(f"message of {len(payload)} bytes, {MAX_BYTES} is the most")
    decoder = _decoders.get(kind)
    if decoder is None:
        decoder = _decoders[kind] = msgspec.json.Decoder(kind, strict=True)
    try:
        message: T = decoder.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ProtocolError(f"not a valid {getattr(kind, '__name__', 'message')}: {error}") from error
    return message


def _finite(value: Any) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, msgspec.Struct):
        return all(_finite(getattr(value, field)) for field in value.__struct_fields__)
    if isinstance(value, dict):
        return all(_finite(item) for item in value.values())
    if isinstance(value, list | tuple):
        return all(_finite(item) for item in value)
    return True
