"""What a script's process may say to the agent: one line of JSON a message, strict and bounded.

The process is hostile until proven otherwise: ``parse`` is the only way in. It is pure, and what it lets pass is
finite, of the right type, and no longer than the bounds below. Whether a value makes sense is asked of the robot.
"""

from typing import Annotated

from msgspec import Meta, Struct

from device_agent.protocol import JointPositions, Quaternion, Vector3, codec

MAX_LINE = 65_536
"""Bytes of a line, with its end. A print of 8,000 characters, each written as six bytes or twelve, fits."""
_Name = Annotated[str, Meta(max_length=200)]
_Text = Annotated[str, Meta(max_length=10_000)]


class _Message(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind"):
    """What is said; its ``kind`` says which."""


class Ready(_Message, frozen=True, kw_only=True, tag="ready"):
    """The jail holds; the script may be sent."""


class Unfit(_Message, frozen=True, kw_only=True, tag="unfit"):
    """The jail does not hold; the process has ended."""

    why: _Text


class Output(_Message, frozen=True, kw_only=True, tag="output"):
    """Something was printed."""

    text: _Text


class Progress(_Message, frozen=True, kw_only=True, tag="progress"):
    """So much is done."""

    share: Annotated[float, Meta(ge=0, le=1)]


class Ended(_Message, frozen=True, kw_only=True, tag="ended"):
    """The script has ended: well, or with an error that names its line."""

    error: _Text = ""


class MoveJoints(_Message, frozen=True, kw_only=True, tag="move_joints"):
    """``robot.move_joints``."""

    position_rad: JointPositions
    speed: float
    plan: bool = False


class MoveTo(_Message, frozen=True, kw_only=True, tag="move_to"):
    """``robot.move_to``; with neither orientation the frame keeps its own, with no frame it is the last."""

    frame: _Name
    position_m: Vector3
    quaternion: Quaternion | None = None
    rpy_rad: Vector3 | None = None
    speed: float
    straight: bool = False
    plan: bool = False


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

    speed: float


class Drive(_Message, frozen=True, kw_only=True, tag="drive"):
    """``robot.drive``."""

    forward_m_s: float
    left_m_s: float
    turn_rad_s: float
    duration_s: float


class GoTo(_Message, frozen=True, kw_only=True, tag="go_to"):
    """``robot.go_to``; without a heading it stands as it comes."""

    x_m: float
    y_m: float
    yaw_rad: float | None = None


class Look(_Message, frozen=True, kw_only=True, tag="look"):
    """``robot.look``."""

    position_m: Vector3
    speed: float


class Say(_Message, frozen=True, kw_only=True, tag="say"):
    """``robot.say``."""

    text: Annotated[str, Meta(max_length=2000)]
    language: Annotated[str, Meta(max_length=35)]


class Stiffness(_Message, frozen=True, kw_only=True, tag="stiffness"):
    """``robot.stiffness``; no joints: all."""

    value: float
    joints: Annotated[tuple[_Name, ...], Meta(max_length=128)]


class Express(_Message, frozen=True, kw_only=True, tag="express"):
    """``robot.express``."""

    name: _Name
    strength: float


class Behaviour(_Message, frozen=True, kw_only=True, tag="behaviour"):
    """``robot.behaviour``."""

    name: _Name


class Posture(_Message, frozen=True, kw_only=True, tag="posture"):
    """``robot.posture``."""

    name: _Name
    speed: float


class AskState(_Message, frozen=True, kw_only=True, tag="state"):
    """``robot.state``."""


class AskLatest(_Message, frozen=True, kw_only=True, tag="latest"):
    """``room.latest``."""

    device: _Name
    stream: _Name


Show = Say | Stiffness | Express | Posture | Behaviour
"""Calls for what a robot shows, by its manifest or by its driver."""
Call = MoveJoints | Play | MoveTo | Home | Drive | GoTo | Look | Show | AskState | AskLatest
"""What the process waits for an answer to."""
Message = Ready | Unfit | Output | Progress | Ended | Call


def parse(line: bytes) -> Message:
    """One message.

    Raises:
        ProtocolError: It is none; the text says what is wrong with it.
    """
    message: Message = codec.decode(line, Message)  # type: ignore[arg-type]
    return message
