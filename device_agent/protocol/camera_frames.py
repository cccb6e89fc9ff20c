"""Pictures at ``cam/{name}``: a header of 20 bytes, then the JPEG. The only messages that are not JSON.

| bytes | what |
| --- | --- |
| 0…1 | ``TS`` |
| 2 | version, 1 |
| 3 | how the picture is encoded: 1 is JPEG |
| 4…7 | sequence: counts up from one start of the agent to the next |
| 8…15 | ``tick_ms``: when it was taken, on the agent's monotonic clock [ms] |
| 16…17, 18…19 | width and height in pixels |

All numbers without sign, the highest byte first (in a browser ``DataView`` without a second thought).
"""

import struct
from typing import NamedTuple

from device_agent.protocol.codec import MAX_BYTES
from device_agent.protocol.errors import ProtocolError

_HEADER = struct.Struct(">2sBBIQHH")
_MAGIC, _VERSION, _JPEG = b"TS", 1, 1
HEADER_BYTES = _HEADER.size
_MOST = 2**32


class CameraFrame(NamedTuple):
    """One picture. ``tick_ms``: when it was taken, on the agent's own clock; ``width`` and ``height`` in pixels."""

    sequence: int
    tick_ms: int
    width: int
    height: int
    jpeg: bytes


def encode(frame: CameraFrame) -> bytes:
    """One picture as it travels.

    Raises:
        ProtocolError: It is longer than a message may be, or its size does not fit the header.
    """
    if HEADER_BYTES + len(frame.jpeg) > MAX_BYTES:
        raise ProtocolError(f"a picture of {len(frame.jpeg)} bytes; {MAX_BYTES - HEADER_BYTES} is the most")
    try:
        header = _HEADER.pack(_MAGIC, _VERSION, _JPEG, frame.sequence % _MOST, frame.tick_ms, frame.width, frame.height)
    except struct.error as error:
        raise ProtocolError(f"a picture of {frame.width} x {frame.height} at {frame.tick_ms} ms: {error}") from error
    return header + frame.jpeg


def decode(payload: bytes) -> CameraFrame:
    """A picture that arrived.

    Raises:
        ProtocolError: It is none of this version.
    """
    if not HEADER_BYTES <= len(payload) <= MAX_BYTES:
        raise ProtocolError(f"a picture of {len(payload)} bytes is none")
    magic, version, kind, sequence, tick_ms, width, height = _HEADER.unpack_from(payload)
    if (magic, version, kind) != (_MAGIC, _VERSION, _JPEG):
        raise ProtocolError("the header is not that of a picture of version 1")
    return CameraFrame(sequence, tick_ms, width, height, payload[HEADER_BYTES:])
