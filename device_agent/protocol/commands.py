"""Messages to a device: signed commands, streamed setpoints and Stop.

An unknown kind is rejected, an unknown field is ignored. A new field must therefore be safe to ignore; a parameter
that an older agent must not ignore needs a new kind.
"""

from typing import Annotated, Any, get_args

from msgspec import UNSET, Meta, Struct, UnsetType

from device_agent.protocol.fields import (
    Count,
    Id,
    JointPositions,
    Label,
    Milliseconds,
    Quaternion,
    Text,
    TraceParent,
    Vector3,
)
from device_agent.protocol.security.key_rotation import MAX_STATEMENTS, Statement

LANGUAGE_PATTERN = r"([A-Za-z]{1,8}(-[A-Za-z0-9]{1,8})*)?"
"""Language tag as in BCP 47 (``en``, ``sk``, ``en-GB``), or empty."""


class _Request(Struct, frozen=True, kw_only=True, tag_field="kind"):
    """Base of all requests; the tag ``kind`` names the request."""


class GrantLease(_Request, frozen=True, kw_only=True, tag="grant_lease"):
    """``holder`` has control for ``lease_ms`` from the time of arrival. Also renews a lease.

    Attributes:
        holder: Name of the operator.
        lease_ms: Duration from arrival [ms].
        reason: Why control was taken from another operator; shown to that operator.
        pairing: Id of the pairing. The key of the lease's setpoints depends on it (``security.setpoints``).
    """

    holder: Label
    lease_ms: Annotated[int, Meta(ge=1, le=3_600_000)]
    reason: Text = ""
    pairing: Label = ""


class ReleaseLease(_Request, frozen=True, kw_only=True, tag="release_lease"):
    """Ends the lease; motion is brought to a hold."""


class RequestControl(_Request, frozen=True, kw_only=True, tag="ask_lease"):
    """Shows all viewers that ``requester`` asks for control. Changes nothing else and expires by itself."""

    request: Id
    requester: Label
    answer_within_ms: Annotated[int, Meta(ge=1, le=3_600_000)]


class WithdrawRequest(_Request, frozen=True, kw_only=True, tag="drop_request"):
    """Removes a request for control that was refused or withdrawn."""

    request: Id


MAX_SEED = 1_000_000
"""Largest seed of a reset of the objects."""
SHIPPED = "telescope"
"""Author of movements that ship with Telescope. Not a valid account id: those are longer."""


class RunMovement(_Request, frozen=True, kw_only=True, tag="run_movement"):
    """Runs one movement script. The source must hash to ``sha256`` (hex).

    Attributes:
        author: Account that saved the movement, or ``SHIPPED``. Versions are counted per author, and a device never
            runs an older version than before.
        key: Id of the cloud's key that signed the movement when it was saved.
        signature: Signature over robot type, name, version and hash.
        timeout_ms: The script is terminated after this time [ms].
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


class RunTrial(_Request, frozen=True, kw_only=True, tag="run_trial"):
    """One trial of a task: resets the objects, runs the movement, and reports the verdict of the task's monitor.

    Attributes:
        name: Task of the manifest ``tasks.toml`` of the robot type.
        tasks_sha256: Hash of that manifest (hex). The device rejects the trial if its own manifest differs.
        seed: Seed of the reset of the objects; null: nothing is reset.
        movement: The movement that attempts the task.
    """

    name: Id
    tasks_sha256: Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
    seed: Annotated[int, Meta(ge=0, le=MAX_SEED)] | None = None
    movement: RunMovement


Speed = Annotated[float, Meta(gt=0, le=1, description="share of each joint's velocity limit")]
Share = Annotated[float, Meta(ge=0, le=1)]


class MoveJoints(_Request, frozen=True, kw_only=True, tag="move_joints"):
    """Move to joint positions. ``plan``: avoid obstacles."""

    position_rad: JointPositions
    speed: Speed = 0.5
    plan: bool = False


class MovePose(_Request, frozen=True, kw_only=True, tag="move_pose"):
    """Move a frame to a pose in the robot's base frame.

    Attributes:
        quaternion: Target orientation (w, x, y, z).
        rpy_rad: Target roll, pitch and yaw about the axes of the base; without either orientation, it is kept.
        frame: Frame to move; empty for the device's last frame.
        straight: Move on a straight line.
        plan: Avoid obstacles.
    """

    position_m: Vector3
    quaternion: Quaternion | None = None
    rpy_rad: Vector3 | None = None
    frame: Label = ""
    speed: Speed = 0.5
    straight: bool = False
    plan: bool = False


class Say(_Request, frozen=True, kw_only=True, tag="say"):
    """Speak ``text``; ends when speech ends. ``language``: ``en``, ``sk`` …; empty for the robot's default."""

    text: Annotated[str, Meta(min_length=1, max_length=2000)]
    language: Annotated[str, Meta(pattern=f"^{LANGUAGE_PATTERN}$")] = ""


class Express(_Request, frozen=True, kw_only=True, tag="express"):
    """Show an expression of the device; ``strength`` 0 is the home position."""

    name: Id
    strength: Share = 1.0


class TakePosture(_Request, frozen=True, kw_only=True, tag="take_posture"):
    """Move to a posture of the device."""

    name: Id
    speed: Speed = 0.5


class RunBehaviour(_Request, frozen=True, kw_only=True, tag="run_behaviour"):
    """Run a behaviour of the device to its end."""

    name: Id


class SetStiffness(_Request, frozen=True, kw_only=True, tag="set_stiffness"):
    """Set the holding strength of joints to the share ``value``; 0: limp. No joints: all. Outlasts the action."""

    value: Share
    joints: Annotated[tuple[Label, ...], Meta(max_length=128)] = ()


class LookAt(_Request, frozen=True, kw_only=True, tag="look_at"):
    """Turn the gaze to a point x, y, z in the robot's base frame [m]."""

    position_m: Vector3
    speed: Speed = 0.5


class Drive(_Request, frozen=True, kw_only=True, tag="drive"):
    """Drive the base at a velocity for a time, then stop; ``turn_rad_s`` is counter-clockwise."""

    forward_m_s: float = 0.0
    left_m_s: float = 0.0
    turn_rad_s: float = 0.0
    duration_s: Annotated[float, Meta(gt=0, le=60)] = 1.0


class GoTo(_Request, frozen=True, kw_only=True, tag="go_to"):
    """Navigate to a position in the room around obstacles; ``yaw_rad``: final heading, counter-clockwise from x."""

    x_m: float
    y_m: float
    yaw_rad: float | None = None


class CollectData(_Request, frozen=True, kw_only=True, tag="gather"):
    """Measure streams of a room device at another rate for a time; no streams: all."""

    streams: Annotated[tuple[Id, ...], Meta(max_length=16)] = ()
    rate_hz: Annotated[float, Meta(ge=0.001, le=50)]
    duration_s: Annotated[float, Meta(gt=0, le=86_400)]


class TakePicture(_Request, frozen=True, kw_only=True, tag="shoot"):
    """Measure streams of a room device once, now; no streams: all. The result contains the ``values``."""

    streams: Annotated[tuple[Id, ...], Meta(max_length=16)] = ()


class CaptureRaw(_Request, frozen=True, kw_only=True, tag="capture"):
    """Capture raw data and upload it; the result names the ``upload``."""

    name: Id


class SetControl(_Request, frozen=True, kw_only=True, tag="set_control"):
    """Set a control of a room device, within its limits and in its unit. The result contains the ``applied`` value."""

    control: Id
    value: float


RoomTask = CollectData | TakePicture | CaptureRaw | SetControl
"""Actions of a room device."""
RobotTask = MoveJoints | MovePose | Say | Express | TakePosture | RunBehaviour | SetStiffness | LookAt | Drive | GoTo
"""Actions of a robot. A movement script makes the same requests with the same messages."""
Task = RobotTask | RoomTask
"""Actions that the API passes to a device unchanged."""


class CancelAction(_Request, frozen=True, kw_only=True, tag="cancel_action"):
    """Cancel the named action; the device holds its position."""

    action: Id


class StopDevice(_Request, frozen=True, kw_only=True, tag="stop_device"):
    """Latch Stop."""

    reason: Text = ""


class ResetStop(_Request, frozen=True, kw_only=True, tag="reset_stop"):
    """Reset the Stop latch. Motion does not resume.

    The command carries an epoch of its own, which ends with it. The device therefore rejects commands issued before the
    reset, and a delayed or repeated reset is older than a newer latch.
    """


class RotateKey(_Request, frozen=True, kw_only=True, tag="follow_key"):
    """Statements that lead to the cloud's newest keys, oldest first (``security.key_rotation``).

    Changes nothing else and does not affect the lease.
    """

    statements: Annotated[tuple[Statement, ...], Meta(min_length=1, max_length=MAX_STATEMENTS)]


class SetCameraConsent(_Request, frozen=True, kw_only=True, tag="consent_cameras"):
    """The owner's decision which cameras of the device may be recorded. It replaces the former decision.

    Attributes:
        cameras: Names of cameras that may be recorded; empty: none.
        account: Account id of the owner. The device accepts only the account that claimed it.
        number: Rises with each decision. The device rejects an older one, so that a copy of it changes nothing.
    """

    cameras: Annotated[tuple[Id, ...], Meta(max_length=16)]
    account: Label
    number: Annotated[int, Meta(ge=1, le=2**53)]


Request = (
    GrantLease
    | ReleaseLease
    | RequestControl
    | WithdrawRequest
    | RunMovement
    | RunTrial
    | Task
    | CancelAction
    | StopDevice
    | ResetStop
    | RotateKey
    | SetCameraConsent
)
KINDS = tuple(sorted(str(kind.__struct_config__.tag) for kind in get_args(Request)))
"""Every kind of request, as agents and servers report them."""


class Command(Struct, frozen=True, kw_only=True):
    """``cmd``: a request to a device; the body of ``signing.Signed``.

    ``space``, ``agent`` and ``device`` bind it to one device, ``epoch`` binds it to one lease. It runs at most once per
    ``id`` and never after ``issued_at_ms + ttl_ms`` on the cloud's clock; the agent tracks the offset of that clock to
    its own monotonic clock. ``traceparent`` names the span that sent it, if the request is traced.
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
    traceparent: TraceParent | UnsetType = UNSET


class JointTarget(_Request, frozen=True, kw_only=True, tag="joints"):
    """Move to joint positions as fast as the limits allow."""

    position_rad: JointPositions


class JogTarget(_Request, frozen=True, kw_only=True, tag="jog"):
    """Move a frame at a velocity while setpoints are fresh; no frame: the device's last frame.

    Velocities are along and about the axes of the robot's base, or with ``tool`` those of the frame itself.
    """

    linear_m_s: Vector3 = (0.0, 0.0, 0.0)
    angular_rad_s: Vector3 = (0.0, 0.0, 0.0)
    frame: Label = ""
    tool: bool = False


class DriveTarget(_Request, frozen=True, kw_only=True, tag="drive"):
    """Drive the base at a velocity while setpoints are fresh; ``turn_rad_s`` is counter-clockwise."""

    forward_m_s: float = 0.0
    left_m_s: float = 0.0
    turn_rad_s: float = 0.0


class Setpoint(Struct, frozen=True, kw_only=True):
    """One streamed setpoint; the body of ``setpoints.Tagged``. The newest is used; ``sequence`` rises in each lease.

    Attributes:
        echo_tick_ms: ``tick_ms`` of the newest telemetry that the operator has received. Its age on the robot's own
            clock is the loop age.
        sent_ms: Time of sending on any clock of the operator [ms]; telemetry echoes it.
        input: Number of the operator's input in this lease, from 1: each press of a pointer, key or gamepad starts a
            new one. After a watchdog hold the device accepts only a higher number. 0: not numbered; a watchdog hold
            then ends the lease.
    """

    epoch: Count
    sequence: Annotated[int, Meta(ge=1, le=2**53)]
    echo_tick_ms: Milliseconds
    sent_ms: float
    target: JointTarget | JogTarget | DriveTarget
    input: Count = 0


class Stop(Struct, frozen=True, kw_only=True):
    """``stop/{author}``: latch Stop now. Needs no lease and no signature, and unknown fields do not prevent it.

    The last topic level is the author's account; the broker allows each account only its own. The device shows this
    author as unverified until the signed ``stop_device`` command arrives.
    """

    id: Id
    reason: str = ""
