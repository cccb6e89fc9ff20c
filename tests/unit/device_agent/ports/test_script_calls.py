"""What passes from a script's process to the agent."""

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device_agent.ports import script_calls
from device_agent.protocol.errors import ProtocolError


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"null",
        b"[]",
        b'{"kind": "fly"}',
        b'{"kind": "home"}',
        b'{"kind": "home", "speed": "1"}',
        b'{"kind": "home", "speed": NaN}',
        b'{"kind": "home", "speed": 1e999}',
        b'{"kind": "home", "speed": 1, "more": 2}',
        b'{"kind": "progress", "share": 1.5}',
        b'{"kind": "move_joints", "position_rad": {}, "speed": 1}',
        b'{"kind": "move_pose", "frame": "x", "position_m": [1, 2], "speed": 1}',
        b'{"kind": "home", "speed": 0}',
        b'{"kind": "express", "name": "smile", "strength": 2}',
        b'{"kind": "say", "text": "%s", "language": ""}' % (b"x" * 2001),
        b"[" * 60_000,
        b"\xff\xfe{}",
    ],
)
def test_what_is_no_message_is_refused(line: bytes) -> None:
    with pytest.raises(ProtocolError):
        script_calls.parse(line)


@given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
def test_anything_is_parsed_or_refused(line: bytes) -> None:
    try:
        message = script_calls.parse(line)
    except ProtocolError:
        return
    assert isinstance(message, script_calls.Message)


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_no_number_passes_that_is_not_finite(value: float) -> None:
    text = repr(value).replace("nan", "NaN").replace("inf", "Infinity")
    try:
        message: Any = script_calls.parse(b'{"kind": "home", "speed": %s}' % text.encode())
    except ProtocolError:
        return
    assert math.isfinite(message.speed)
