"""Messages from a script's process to the agent; the fuzzer tries random ones."""

import pytest

from device_agent.ports import script_calls
from device_agent.protocol.errors import ProtocolError


@pytest.mark.parametrize(
    "line",
    [
        *(b"", b"null", b"[]", b"[" * 60_000, b"\xff\xfe{}", b'{"kind": "fly"}', b'{"kind": "home"}'),
        *(b'{"kind": "home", "speed": %s}' % speed for speed in (b'"1"', b"NaN", b"1e999", b"0", b'1, "more": 2')),
        b'{"kind": "progress", "share": 1.5}',
        b'{"kind": "move_joints", "position_rad": {}, "speed": 1}',
        b'{"kind": "move_pose", "frame": "x", "position_m": [1, 2], "speed": 1}',
        b'{"kind": "express", "name": "smile", "strength": 2}',
        b'{"kind": "say", "text": "%s", "language": ""}' % (b"x" * 2001),
    ],
)
def test_invalid_messages_are_rejected(line: bytes) -> None:
    with pytest.raises(ProtocolError):
        script_calls.parse(line)
