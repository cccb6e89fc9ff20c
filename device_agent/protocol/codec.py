"""Strict JSON encoding and decoding of messages, with finite numbers only.

The decoder rejects NaN, infinities and out-of-range numbers. The encoder raises instead of writing ``null`` for them,
as ``msgspec`` would.
"""

import math
from typing import Any, TypeVar

import msgspec

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.fields import printable

MAX_BYTES = 128 * 1024
"""Maximum message size of AWS IoT Core."""
MAX_RETAINED_BYTES = 64 * 1024
"""Maximum retained message size of Azure Event Grid."""

T = TypeVar("T")
_encoder = msgspec.json.Encoder()
_decoders: dict[Any, msgspec.json.Decoder[Any]] = {}


def encode(message: Any, *, limit: int = MAX_BYTES) -> bytes:
    """Encode one message as JSON.

    Raises:
        ProtocolError: The message holds a NaN or an infinity, or is longer than ``limit`` bytes.
    """
    payload = _encoder.encode(message)
    if b"null" in payload and not _finite(message):  # msgspec writes null for them
        raise ProtocolError(f"{type(message).__name__} contains a number that is not finite")
    if len(payload) > limit:
        raise ProtocolError(f"{type(message).__name__} has {len(payload)} bytes; the limit is {limit}")
    return payload


def decode(payload: bytes, kind: type[T]) -> T:
    """Decode a message of the given type.

    Raises:
        ProtocolError: The payload is not JSON, not of this type, not finite or longer than ``MAX_BYTES``. The message
            names the field.
    """
    if len(payload) > MAX_BYTES:
        raise ProtocolError(f"the message has {len(payload)} bytes; the limit is {MAX_BYTES}")
    decoder = _decoders.get(kind)
    if decoder is None:
        decoder = _decoders[kind] = msgspec.json.Decoder(kind, strict=True)
    try:
        message: T = decoder.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ProtocolError(printable(f"not a valid {getattr(kind, '__name__', 'message')}: {error}")) from error
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
