"""Frames of every kind keep their header and content; others are rejected."""

import struct

import pytest

from device_agent.protocol import CameraStream, Description, camera_frames, codec
from device_agent.protocol.camera_frames import HEADER_BYTES, KINDS, MAX_CONTENT_BYTES, CameraFrame, decode, encode
from device_agent.protocol.errors import ProtocolError

FRAME = CameraFrame(sequence=7, tick_ms=2**40, width=320, height=240, content=b"content")


@pytest.mark.parametrize("kind", KINDS)
def test_a_frame_of_each_kind_is_decoded_as_it_was_encoded(kind: str) -> None:
    frame = FRAME._replace(kind=kind)
    payload = encode(frame)
    assert decode(payload) == frame
    assert payload[:4] == b"TS\x01" + bytes((KINDS[kind],))
    assert len(payload) == HEADER_BYTES + len(frame.content)


def test_a_frame_without_a_kind_is_a_picture_as_older_agents_send_it() -> None:
    header = struct.pack(">2sBBIQHH", b"TS", 1, 1, 7, 2**40, 320, 240)
    assert encode(FRAME) == header + b"content"
    assert decode(header + b"content").kind == camera_frames.COLOUR


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (FRAME._replace(kind="thermal"), "kind 'thermal'; known: colour, depth, scan, people"),
        (FRAME._replace(content=bytes(MAX_CONTENT_BYTES + 1)), f"the limit is {MAX_CONTENT_BYTES}"),
        (FRAME._replace(width=70_000), "frame of 70000 x 240"),
    ],
)
def test_frames_that_no_receiver_accepts_are_rejected(frame: CameraFrame, message: str) -> None:
    with pytest.raises(ProtocolError, match=message):
        encode(frame)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        encode(FRAME)[: HEADER_BYTES - 1],
        b"XX" + encode(FRAME)[2:],
        b"TS\x02" + encode(FRAME)[3:],
        b"TS\x01\x00" + encode(FRAME)[4:],
        b"TS\x01\x05" + encode(FRAME)[4:],
        encode(FRAME) + bytes(codec.MAX_BYTES),
    ],
)
def test_other_payloads_are_rejected(payload: bytes) -> None:
    with pytest.raises(ProtocolError, match="camera frame"):
        decode(payload)


def test_the_kind_of_a_stream_is_additive_in_the_description() -> None:
    described = Description(
        device="d", kind="k", robot_type="r", label="l", cameras=(CameraStream(name="a", rate_hz=5.0, kind="depth"),)
    )
    assert codec.decode(codec.encode(described), Description).cameras[0].kind == "depth"
    before = b'{"device":"d","kind":"k","robot_type":"r","label":"l","cameras":[{"name":"a","rate_hz":5.0}]}'
    assert codec.decode(before, Description).cameras[0].kind == "colour"
    later = before.replace(b'"rate_hz":5.0', b'"rate_hz":5.0,"kind":"thermal"')
    assert codec.decode(later, Description).cameras[0].kind == "thermal", "receivers ignore streams of unknown kinds"
