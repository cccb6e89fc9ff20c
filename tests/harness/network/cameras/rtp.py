"""RTP packets of encoded pictures: H.264 (RFC 6184) and JPEG (RFC 2435)."""

import functools
import struct
from collections.abc import Iterator, Sequence
from fractions import Fraction

import av

from tests.harness.network.cameras.pictures import HEIGHT, WIDTH, jpeg, rgb

H264, JPEG = 96, 26
"""Payload types; JPEG has a fixed one."""
CLOCK_HZ = 90_000
COUNT = 25
"""Number of different pictures, the first of which is a keyframe; streams repeat them."""
_MAX_PAYLOAD = 1200
_SINGLE_UNIT_MAX, _FU_A = 0x1F, 28


@functools.cache
def payloads(kind: int) -> tuple[tuple[bytes, ...], ...]:
    """The payloads of each picture in turn."""
    return tuple(map(tuple, _h264() if kind == H264 else map(_jpeg, range(COUNT))))


def packet(kind: int, sequence: int, timestamp: int, payload: bytes, *, last: bool) -> bytes:
    marker = 0x80 if last else 0
    return struct.pack("!BBHII", 0x80, kind | marker, sequence % 2**16, timestamp % 2**32, 0x7E1E5C09) + payload


def _h264() -> Iterator[list[bytes]]:
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    encoder.time_base = Fraction(1, 25)
    encoder.options = {"preset": "ultrafast", "tune": "zerolatency", "x264-params": "keyint=25:scenecut=0:threads=1"}
    for number in range(COUNT):
        frame = av.VideoFrame.from_ndarray(rgb(5 * number), format="rgb24").reformat(format="yuv420p")
        frame.pts = number
        stream = b"".join(bytes(each) for each in encoder.encode(frame))
        yield [payload for unit in _units(stream) for payload in _fragments(unit)]


def _units(stream: bytes) -> Sequence[bytes]:
    """NAL units of a byte stream, without start codes."""
    return [unit.rstrip(b"\0") for unit in stream.split(b"\0\0\1") if unit.rstrip(b"\0")]


def _fragments(unit: bytes) -> Iterator[bytes]:
    if len(unit) <= _MAX_PAYLOAD:
        yield unit
        return
    indicator, kind = unit[0] & 0xE0 | _FU_A, unit[0] & _SINGLE_UNIT_MAX
    body = unit[1:]
    for start in range(0, len(body), _MAX_PAYLOAD):
        end = start + _MAX_PAYLOAD
        flags = (0x80 if start == 0 else 0) | (0x40 if end >= len(body) else 0)
        yield bytes((indicator, kind | flags)) + body[start:end]


def _jpeg(number: int) -> Iterator[bytes]:
    """A JPEG with 4:2:0 subsampling and its own quantization tables."""
    content = jpeg(number)
    tables = b"".join(_segments(content, 0xDB))
    quantization = tables[1:65] + tables[66:130]
    scan_header = content.index(b"\xff\xda")
    (length,) = struct.unpack_from("!H", content, scan_header + 2)
    scan = content[scan_header + 2 + length : -2]
    for offset in range(0, len(scan), _MAX_PAYLOAD):
        head = struct.pack("!IBBBB", offset, 1, 255, WIDTH // 8, HEIGHT // 8)
        if offset == 0:
            head += struct.pack("!BBH", 0, 0, len(quantization)) + quantization
        yield head + scan[offset : offset + _MAX_PAYLOAD]


def _segments(content: bytes, marker: int) -> Iterator[bytes]:
    position = 2
    while content[position + 1] != 0xDA:
        (length,) = struct.unpack_from("!H", content, position + 2)
        if content[position + 1] == marker:
            yield content[position + 4 : position + 2 + length]
        position += 2 + length
