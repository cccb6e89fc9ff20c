"""What a script's process may say to the agent: one line of JSON a message, strict and bounded.

The process is hostile until proven otherwise: ``parse`` is the only way in. It is pure, and what it lets pass is
finite, of the right type, and no longer than the bounds below. Whether a value makes sense is asked of the robot.
"""

from typing import Annotated

from msgspec import Meta, Struct

from device_agent.protocol import RobotTask, codec
from device_agent.protocol.commands import Speed

MAX_LINE = 65_536
"""Bytes of a line, with its end. A print of 8,000 characters, each written as six bytes or twelve, fits."""
_Name = Annotated[str, Meta(max_length=200)]
_Text = Annotated[str, Meta(max_length=10_000)]


class _Message(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind"):
    """What is said; its ``kind`` says which."""


class Ready(_Message, frozen=True, kw_only=True, tag="ready"):
    """The sandbox holds; the script may be sent."""


class Unfit(_Message, frozen=True, kw_only=True, tag="unfit"):
    """the sandbox could not be set up; the process has ended."""

    reason: _Text


class Output(_Message, frozen=True, kw_only=True, tag="output"):
    """Something was printed."""

    text: _Text


class Progress(_Message, frozen=True, kw_only=True, tag="progress"):
    """So much is done."""

    share: Annotated[float, Meta(ge=0, le=1)]


class Ended(_Message, frozen=True, kw_only=True, tag="ended"):
    """The script has ended: well, or with an error that names its line."""

    error: _Text = ""


class Moment(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One of the keyframes of ``robot.play``: when, and where the joints that it names are then."""

    time_s: float
    position_rad: Annotated[dict[str, float], Meta(max_length=128)] = {}


class Play(_Message, frozen=True, kw_only=True, tag="play"):
    """``robot.play``, as far as nothing but joints moves: times count from where the joints rest now.

    ``first``: what number the first of the keyframes has in the whole of it, to say which is meant.
    """

    keyframes: Annotated[tuple[Moment, ...], Meta(min_length=1, max_length=1000)]
    first: Annotated[int, Meta(ge=1)] = 1
    speed: float


class Home(_Message, frozen=True, kw_only=True, tag="home"):
    """``robot.home``."""

    speed: Speed


class AskState(_Message, frozen=True, kw_only=True, tag="state"):
    """``robot.state``."""


class AskLatest(_Message, frozen=True, kw_only=True, tag="latest"):
    """``room.latest``."""

    device: _Name
    stream: _Name


Call = RobotTask | Play | Home | AskState | AskLatest
"""Messages that the agent answers. ``RobotTask`` is shared with the commands of the wire contract."""
Message = Ready | Unfit | Output | Progress | Ended | Call


def parse(line: bytes) -> Message:
    """One message.

    Raises:
        ProtocolError: It is none; the text says what is wrong with it.
    """
    message: Message = codec.decode(line, Message)  # type: ignore[arg-type]
    return message
