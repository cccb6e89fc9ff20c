"""Frames at ``cam/{name}``: a header of 20 bytes, then the content. The only messages that are not JSON.

| bytes | content |
| --- | --- |
| 0…1 | ``TS`` |
| 2 | version, 1 |
| 3 | kind of the frame, see below |
| 4…7 | sequence; starts anew with each start of the agent |
| 8…15 | ``tick_ms``: time of the measurement on the agent's monotonic clock [ms] |
| 16…17, 18…19 | width and height |

All numbers are unsigned and big-endian, the default of ``DataView`` in a browser. The description of the device states
the kind of each stream:

| byte 3 | kind | content | width, height |
| --- | --- | --- | --- |
| 1 | ``colour`` | JPEG | pixels |
| 2 | ``depth`` | PNG with 16-bit grey values: depth along the viewing direction [mm], 0 without an echo | pixels |
| 3 | ``scan`` | JSON, ``LidarScan`` | number of beams, 1 |
| 4 | ``people`` | JSON, ``TrackedPeople`` | number of people, 1 |
"""

import struct
from collections.abc import Mapping
from typing import NamedTuple

from device_agent.protocol.codec import MAX_BYTES
from device_agent.protocol.errors import ProtocolError

COLOUR, DEPTH, SCAN, PEOPLE = "colour", "depth", "scan", "people"
KINDS: Mapping[str, int] = {COLOUR: 1, DEPTH: 2, SCAN: 3, PEOPLE: 4}
"""Kind of a frame → byte 3 of its header."""
_KIND_OF = {code: kind for kind, code in KINDS.items()}
_HEADER = struct.Struct(">2sBBIQHH")
_MAGIC, _VERSION = b"TS", 1
HEADER_BYTES = _HEADER.size
_SEQUENCE_MODULUS = 2**32
MAX_CONTENT_BYTES = MAX_BYTES - HEADER_BYTES
"""Maximum size of the content of a frame [bytes]."""
_START = b"\xff\xd8"
_MARKER = 0xFF
_STANDALONE = {0x01, *range(0xD0, 0xDA)}
_SIZED = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of a JPEG that start a frame."""


class CameraFrame(NamedTuple):
    """One frame. ``tick_ms``: time of the measurement on the agent's monotonic clock; other fields: see above."""

    sequence: int
    tick_ms: int
    width: int
    height: int
    content: bytes
    kind: str = COLOUR


def encode(frame: CameraFrame) -> bytes:
    """Encode one frame.

    Raises:
        ProtocolError: The kind is unknown, the frame exceeds the maximum message size, or a number does not fit.
    """
    if frame.kind not in KINDS:
        raise ProtocolError(f"a frame has the kind '{frame.kind}'; known: {', '.join(KINDS)}")
    if len(frame.content) > MAX_CONTENT_BYTES:
        raise ProtocolError(f"the frame has {len(frame.content)} bytes; the limit is {MAX_CONTENT_BYTES}")
    sequence = frame.sequence % _SEQUENCE_MODULUS
    try:
        header = _HEADER.pack(_MAGIC, _VERSION, KINDS[frame.kind], sequence, frame.tick_ms, frame.width, frame.height)
    except struct.error as error:
        raise ProtocolError(f"frame of {frame.width} x {frame.height} at {frame.tick_ms} ms: {error}") from error
    return header + frame.content


def decode(payload: bytes) -> CameraFrame:
    """Decode the header of a received frame.

    Raises:
        ProtocolError: The payload is not a frame of this version, or its kind is unknown.
    """
    if not HEADER_BYTES <= len(payload) <= MAX_BYTES:
        raise ProtocolError(f"a payload of {len(payload)} bytes is not a camera frame")
    magic, version, code, sequence, tick_ms, width, height = _HEADER.unpack_from(payload)
    if (magic, version) != (_MAGIC, _VERSION) or code not in _KIND_OF:
        raise ProtocolError("the header is not that of a camera frame of version 1 and a known kind")
    return CameraFrame(sequence, tick_ms, width, height, payload[HEADER_BYTES:], _KIND_OF[code])


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
