"""What travels towards a robot: signed commands, streamed setpoints, Stop.

Unknown fields are refused: an old agent must not obey half of a newer order.
"""

from typing import Annotated, Any

from msgspec import Meta, Struct

from device_agent.protocol.fields import Count, Id, JointPositions, Label, Milliseconds, Quaternion, Text, Vector3
from device_agent.protocol.security.key_rotation import MAX_STATEMENTS, Statement

LANGUAGE_PATTERN = r"([A-Za-z]{1,8}(-[A-Za-z0-9]{1,8})*)?"
"""As in BCP 47: ``en``, ``sk``, ``en-GB``; or nothing."""


class _Order(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind"):
    """What is asked; its ``kind`` says which."""


class GrantLease(_Order, frozen=True, kw_only=True, tag="grant_lease"):
    """Control of the device now belongs to ``holder``, for ``lease_ms`` from the moment of arrival. Also renews.

    ``reason``: why it was taken from somebody else, for that person to read.
    """

    holder: Label
    lease_ms: Annotated[int, Meta(ge=1, le=3_600_000)]
    reason: Text = ""


class ReleaseLease(_Order, frozen=True, kw_only=True, tag="release_lease"):
    """Nobody controls the device any more; what moves is brought to a hold."""


class RequestControl(_Order, frozen=True, kw_only=True, tag="ask_lease"):
    """Show the holder, and everybody, that somebody asks for control. Changes nothing else; lapses by itself."""

    request: Id
    requester: Label
    answer_within_ms: Annotated[int, Meta(ge=1, le=3_600_000)]


class WithdrawRequest(_Order, frozen=True, kw_only=True, tag="drop_request"):
    """Nobody asks any more: refused, or withdrawn."""

    request: Id


SHIPPED = "telescope"
"""The author of movements that come with Telescope's own robot types. No account's id: those are longer."""


class RunMovement(_Order, frozen=True, kw_only=True, tag="run_movement"):
    """Run one movement script. The source must hash to ``sha256`` (hex).

    ``signature`` is the one that was made, with the cloud's key ``key``, when the movement was saved: over robot type,
    name, version and hash. ``author`` is the account that saved it, or ``SHIPPED``: each author counts versions by
    itself, and a device never runs an older one than it has. It is ended after ``timeout_ms``.
    """

    robot_type: Id
    name: Id
    version: Count
    sha256: Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
    source: Annotated[str, Meta(max_length=64_000)]
    parameters: dict[str, Any] = {}
    author: Label = ""
    key: Label = ""
    signature: Label = ""
    timeout_ms: Annotated[int, Meta(ge=1, le=86_400_000)] = 600_000


Speed = Annotated[float, Meta(gt=0, le=1, description="share of each joint's velocity limit")]
Share = Annotated[float, Meta(ge=0, le=1)]


class MoveJoints(_Order, frozen=True, kw_only=True, tag="move_joints"):
    """Move to joint positions and end there; ``plan``: around what is in between."""

    position_rad: JointPositions
    speed: Speed = 0.5
    plan: bool = False


class MovePose(_Order, frozen=True, kw_only=True, tag="move_pose"):
    """Bring a frame to a pose in the robot's base frame and end there; no frame: the last of the device's.

    The orientation is a quaternion (w, x, y, z), or roll, pitch and yaw about the base's axes; with neither the frame
    keeps its own. ``straight``: on a straight line. ``plan``: around what is in between.
    """

    position_m: Vector3
    quaternion: Quaternion | None = None
    rpy_rad: Vector3 | None = None
    frame: Label = ""
    speed: Speed = 0.5
    straight: bool = False
    plan: bool = False


class Say(_Order, frozen=True, kw_only=True, tag="say"):
    """Speak ``text``, and end when it is said; ``language`` as ``en`` or ``sk``, or empty for the robot's own."""

    text: Annotated[str, Meta(min_length=1, max_length=2000)]
    language: Annotated[str, Meta(pattern=f"^{LANGUAGE_PATTERN}$")] = ""


class Express(_Order, frozen=True, kw_only=True, tag="express"):
    """Show one of the device's expressions; ``strength`` 0 is home."""

    name: Id
    strength: Share = 1.0


class TakePosture(_Order, frozen=True, kw_only=True, tag="take_posture"):
    """Move to one of the device's postures."""

    name: Id
    speed: Speed = 0.5


class RunBehaviour(_Order, frozen=True, kw_only=True, tag="run_behaviour"):
    """Run one of the device's behaviours to its end."""

    name: Id


class SetStiffness(_Order, frozen=True, kw_only=True, tag="set_stiffness"):
    """Let joints hold with ``value`` of their strength, 0: limp; no joints: all. It lasts beyond the action."""

    value: Share
    joints: Annotated[tuple[Label, ...], Meta(max_length=128)] = ()


class LookAt(_Order, frozen=True, kw_only=True, tag="look_at"):
    """Turn the gaze to a point x, y, z in the robot's base frame [m]."""

    position_m: Vector3
    speed: Speed = 0.5


class Drive(_Order, frozen=True, kw_only=True, tag="drive"):
    """Move the base at a velocity for a time, then stand; ``turn_rad_s`` is counter-clockwise."""

    forward_m_s: float = 0.0
    left_m_s: float = 0.0
    turn_rad_s: float = 0.0
    duration_s: Annotated[float, Meta(gt=0, le=60)] = 1.0


class GoTo(_Order, frozen=True, kw_only=True, tag="go_to"):
    """Go to a place in the room, around what stands there now; ``yaw_rad``: how to stand, counter-clockwise from x."""

    x_m: float
    y_m: float
    yaw_rad: float | None = None


class CollectData(_Order, frozen=True, kw_only=True, tag="gather"):
    """Measure these streams of a room device at this rate for a time, then again as before; no streams: all."""

    streams: Annotated[tuple[Id, ...], Meta(max_length=16)] = ()
    rate_hz: Annotated[float, Meta(ge=0.001, le=50)]
    duration_s: Annotated[float, Meta(gt=0, le=86_400)]


class TakePicture(_Order, frozen=True, kw_only=True, tag="shoot"):
    """Measure these streams of a room device once, now; no streams: all. The result has the ``values``."""

    streams: Annotated[tuple[Id, ...], Meta(max_length=16)] = ()


class CaptureRaw(_Order, frozen=True, kw_only=True, tag="capture"):
    """Take a raw picture or scan and store it; the result names the ``upload``."""

    name: Id


class SetControl(_Order, frozen=True, kw_only=True, tag="set_control"):
    """Set a control of a room device, within its limits and in its unit; the result says what was ``applied``."""

    control: Id
    value: float


RoomTask = CollectData | TakePicture | CaptureRaw | SetControl
"""What is done with devices of a room."""
RobotTask = MoveJoints | MovePose | Say | Express | TakePosture | RunBehaviour | SetStiffness | LookAt | Drive | GoTo
"""Actions of a robot. A movement script makes the same requests with the same messages."""
Task = RobotTask | RoomTask
"""Actions that the API passes to a device unchanged."""


class CancelAction(_Order, frozen=True, kw_only=True, tag="cancel_action"):
    """End the named action; the device holds where it is."""

    action: Id


class StopDevice(_Order, frozen=True, kw_only=True, tag="stop_device"):
    """Latch Stop."""

    reason: Text = ""


class ResetStop(_Order, frozen=True, kw_only=True, tag="reset_stop"):
    """Release the Stop latch. Nothing resumes.

    It brings an epoch of its own, which ends with it: what was ordered before the reset is never obeyed after it, and a
    reset that comes late, or again, is older than the latch that it finds.
    """


class RotateKey(_Order, frozen=True, kw_only=True, tag="follow_key"):
    """The cloud has new keys: statements that lead to the newest, oldest first (``device_agent.protocol.security.key_rotation``).

    Changes nothing else, and takes the device from nobody.
    """

    statements: Annotated[tuple[Statement, ...], Meta(min_length=1, max_length=MAX_STATEMENTS)]


Request = (
    GrantLease
    | ReleaseLease
    | RequestControl
    | WithdrawRequest
    | RunMovement
    | Task
    | CancelAction
    | StopDevice
    | ResetStop
    | RotateKey
)


class Command(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``cmd``: a request to a device; travels inside ``signing.Signed``.

    ``space``, ``agent`` and ``device`` bind it to one device, ``epoch`` to one lease; it runs at most once per
    ``id`` and never later than ``issued_at_ms + ttl_ms`` on the cloud's clock, which the agent reads as an offset to
    its own monotonic clock.
    """

    id: Id
    space: Id
    agent: Id
    device: Id
    issued_at_ms: Milliseconds
    ttl_ms: Annotated[int, Meta(ge=1, le=86_400_000)]
    caller: Label
    epoch: Count
    request: Request


class JointTarget(_Order, frozen=True, kw_only=True, tag="joints"):
    """Go to these joint positions, as fast as limits allow."""

    position_rad: JointPositions


class JogTarget(_Order, frozen=True, kw_only=True, tag="jog"):
    """Move a frame at this velocity while setpoints are fresh; no frame: the last of the device's.

    Along and about the axes of the robot's base, or with ``tool`` those of the frame itself.
    """

    linear_m_s: Vector3 = (0.0, 0.0, 0.0)
    angular_rad_s: Vector3 = (0.0, 0.0, 0.0)
    frame: Label = ""
    tool: bool = False


class DriveTarget(_Order, frozen=True, kw_only=True, tag="drive"):
    """Move the base at this velocity while setpoints are fresh; ``turn_rad_s`` is counter-clockwise."""

    forward_m_s: float = 0.0
    left_m_s: float = 0.0
    turn_rad_s: float = 0.0


class Setpoint(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``ctl/{epoch}``: one streamed setpoint. The newest wins; ``sequence`` starts at 1 in each lease.

    ``echo_tick_ms`` is ``tick_ms`` of the last telemetry the operator saw: its age on the robot's own clock is the
    loop age. ``sent_ms`` is any clock of the operator's [ms]; telemetry echoes it.
    """

    epoch: Count
    sequence: Annotated[int, Meta(ge=1, le=2**53)]
    echo_tick_ms: Milliseconds
    sent_ms: float
    target: JointTarget | JogTarget | DriveTarget


class Stop(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``stop``: latch Stop now. Needs no lease and no signature: the broker lets only those publish it who may."""

    id: Id
    caller: Label
    reason: Text = ""
