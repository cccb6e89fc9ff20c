"""Messages from a script process to the agent: one strict, bounded line of JSON each.

The process counts as hostile: ``parse`` is the only entry. It has no side effects and accepts only finite values of the
right type within the bounds below. The robot's API checks the meaning of the values.
"""

from typing import Annotated

from msgspec import Meta, Struct

from device_agent.protocol import RobotTask, SetControl, codec
from device_agent.protocol.commands import Speed

MAX_LINE = 65_536
"""Maximum size of a line [bytes]; fits a print of 8,000 escaped characters."""
_Name = Annotated[str, Meta(max_length=200)]
_Text = Annotated[str, Meta(max_length=10_000)]


class _Message(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind"):
    """Base of all messages; the tag ``kind`` names the message."""


class Ready(_Message, frozen=True, kw_only=True, tag="ready"):
    """The process is confined; the agent may send the script."""


class Unfit(_Message, frozen=True, kw_only=True, tag="unfit"):
    """The process could not be confined, and has ended."""

    reason: _Text


class Output(_Message, frozen=True, kw_only=True, tag="output"):
    """Printed text."""

    text: _Text


class Progress(_Message, frozen=True, kw_only=True, tag="progress"):
    """Share of the work that is done."""

    share: Annotated[float, Meta(ge=0, le=1)]


class Ended(_Message, frozen=True, kw_only=True, tag="ended"):
    """The script has ended, successfully or with an error that names its line."""

    error: _Text = ""


class PlayKeyframe(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One keyframe of ``robot.play``: time, and joint positions at that time."""

    time_s: float
    position_rad: Annotated[dict[str, float], Meta(max_length=128)] = {}


class Play(_Message, frozen=True, kw_only=True, tag="play"):
    """Keyframes of ``robot.play`` that move joints only. Times count from the current rest position.

    ``first``: number of the first of these keyframes in the whole call, for error messages.
    """

    keyframes: Annotated[tuple[PlayKeyframe, ...], Meta(min_length=1, max_length=1000)]
    first: Annotated[int, Meta(ge=1)] = 1
    speed: float


class Home(_Message, frozen=True, kw_only=True, tag="home"):
    """``robot.home``."""

    speed: Speed


class GetState(_Message, frozen=True, kw_only=True, tag="state"):
    """``robot.state``."""


class GetLatest(_Message, frozen=True, kw_only=True, tag="latest"):
    """``room.latest``."""

    device: _Name
    stream: _Name


class Wait(_Message, frozen=True, kw_only=True, tag="wait"):
    """``wait``, where simulated time passes only on request; elsewhere the process waits by itself."""

    duration_s: Annotated[float, Meta(ge=0, le=3600)]


Call = RobotTask | SetControl | Play | Home | GetState | GetLatest | Wait
"""Messages to which the agent responds. ``RobotTask`` is shared with the commands of the wire contract."""
Message = Ready | Unfit | Output | Progress | Ended | Call


def parse(line: bytes) -> Message:
    """Parse one message.

    Raises:
        ProtocolError: The line is not a valid message; the text names the mistake.
    """
    message: Message = codec.decode(line, Message)  # type: ignore[arg-type]
    return message
