"""Camera frames at ``cam/{name}``: a header of 20 bytes, then the JPEG. The only messages that are not JSON.

| bytes | content |
| --- | --- |
| 0…1 | ``TS`` |
| 2 | version, 1 |
| 3 | encoding; 1: JPEG |
| 4…7 | sequence; starts anew with each start of the agent |
| 8…15 | ``tick_ms``: time of exposure on the agent's monotonic clock [ms] |
| 16…17, 18…19 | width and height [pixels] |

All numbers are unsigned and big-endian, the default of ``DataView`` in a browser.
"""

import struct
from typing import NamedTuple

from device_agent.protocol.codec import MAX_BYTES
from device_agent.protocol.errors import ProtocolError

_HEADER = struct.Struct(">2sBBIQHH")
_MAGIC, _VERSION, _JPEG = b"TS", 1, 1
HEADER_BYTES = _HEADER.size
_SEQUENCE_MODULUS = 2**32
MAX_JPEG_BYTES = MAX_BYTES - HEADER_BYTES
_START = b"\xff\xd8"
_MARKER = 0xFF
_STANDALONE = {0x01, *range(0xD0, 0xDA)}
_SIZED = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of a JPEG that start a frame."""


class CameraFrame(NamedTuple):
    """One frame. ``tick_ms``: time of exposure on the agent's monotonic clock; ``width`` and ``height`` in pixels."""

    sequence: int
    tick_ms: int
    width: int
    height: int
    jpeg: bytes


def encode(frame: CameraFrame) -> bytes:
    """Encode one frame.

    Raises:
        ProtocolError: The frame exceeds the maximum message size, or a number does not fit the header.
    """
    if len(frame.jpeg) > MAX_JPEG_BYTES:
        raise ProtocolError(f"the frame has {len(frame.jpeg)} bytes; the limit is {MAX_JPEG_BYTES}")
    try:
        header = _HEADER.pack(
            _MAGIC, _VERSION, _JPEG, frame.sequence % _SEQUENCE_MODULUS, frame.tick_ms, frame.width, frame.height
        )
    except struct.error as error:
        raise ProtocolError(f"frame of {frame.width} x {frame.height} at {frame.tick_ms} ms: {error}") from error
    return header + frame.jpeg


def decode(payload: bytes) -> CameraFrame:
    """Decode a received frame.

    Raises:
        ProtocolError: The payload is not a frame of this version.
    """
    if not HEADER_BYTES <= len(payload) <= MAX_BYTES:
        raise ProtocolError(f"a payload of {len(payload)} bytes is not a camera frame")
    magic, version, kind, sequence, tick_ms, width, height = _HEADER.unpack_from(payload)
    if (magic, version, kind) != (_MAGIC, _VERSION, _JPEG):
        raise ProtocolError("the header is not that of a camera frame of version 1")
    return CameraFrame(sequence, tick_ms, width, height, payload[HEADER_BYTES:])


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Width and height of a JPEG [pixels].

    Raises:
        ValueError: It is no JPEG.
    """
    position = len(_START)
    while data.startswith(_START) and position + 9 <= len(data) and data[position] == _MARKER:
        marker = data[position + 1]
        if marker in _STANDALONE:
            position += 2
            continue
        length, _, height, width = struct.unpack_from(">HBHH", data, position + 2)
        if marker in _SIZED:
            return width, height
        position += 2 + length
    raise ValueError("a picture is no JPEG")
