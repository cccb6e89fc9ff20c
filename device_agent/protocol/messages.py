"""The messages of the wire contract, one struct each.

What travels towards a robot (``Command``, ``Setpoint``, ``Stop``) refuses unknown fields: an old agent must not obey
half of a newer order. What travels from an agent lets them pass, so that an old console still reads a newer robot.

Times: ``at_ms`` is the sender's wall clock [ms since 1970, UTC], to show and to store; ``tick_ms`` is the agent's
monotonic clock [ms], the only one that safety reads. Quaternions are (w, x, y, z).
"""

from enum import StrEnum
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from device_agent.protocol.topics import ID_PATTERN

Id = Annotated[str, Meta(pattern=f"^{ID_PATTERN}$", description="letters, digits, _ and -, 1 to 64 of them")]
Text = Annotated[str, Meta(max_length=2000)]
Label = Annotated[str, Meta(max_length=200)]
Count = Annotated[int, Meta(ge=0, le=2**53)]
Milliseconds = Annotated[int, Meta(ge=0, le=2**53)]
FIELD_PATTERN = r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,79}"
Field = Annotated[
    str, Meta(pattern=f"^{FIELD_PATTERN}$", description="letters, digits, _, - and dots, 1 to 80 of them")
]
MAX_VALUES = 128
"""Values in one message of measurements."""
Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Pose = Annotated[
    tuple[float, float, float, float, float, float, float],
    Meta(description="position x, y, z [m] and quaternion w, x, y, z of a frame in the robot's base"),
]
JointPositions = Annotated[
    dict[str, float],
    Meta(min_length=1, max_length=128, description="joint name → position [rad]; joints not named keep their target"),
]


# ---------------------------------------------------------------- agent →


class Presence(Struct, frozen=True, kw_only=True):
    """``conn``: the agent's link to the broker. Retained, and the will.

    ``session`` rises at each connection; an ``online=False`` with a lower session than one already seen is old news.
    """

    online: bool
    session: Count
    at_ms: Milliseconds
    software: Label = ""


class Joint(Struct, frozen=True, kw_only=True):
    """One joint and the limits that the agent enforces."""

    name: Label
    label: Label
    lower_rad: float
    upper_rad: float
    max_velocity_rad_s: float
    max_acceleration_rad_s2: float
    max_jerk_rad_s3: float
    max_effort_nm: float


class Stream(Struct, frozen=True, kw_only=True):
    """One stream at ``tele/{name}``: ``joints`` carries ``JointTelemetry``, all others ``Measurements``."""

    name: Id
    rate_hz: float


class InterlockRule(Struct, frozen=True, kw_only=True):
    """When the room slows or holds the device: on its condition, and when its sensor was silent for ``stale_ms``.

    ``name`` says device, stream and condition; ``speed`` is the share that is left, 0 for ``hold``.
    """

    name: Text
    action: Literal["slow", "hold"]
    speed: float
    stale_ms: Milliseconds


class Description(Struct, frozen=True, kw_only=True):
    """``desc``: what the device is and can do. Retained.

    ``limits`` names what the agent itself holds, whoever moves the device: ``clearance`` and ``workspace`` are missing
    where nobody knows the robot's shape.

    ``scripts``: movement scripts run in the jail, run with less (``trusted``, as the agent's owner wants it), or are
    refused; ``scripts_note`` says why, and what to do.
    """

    device: Id
    kind: Label
    robot_type: Id
    label: Label
    joints: tuple[Joint, ...] = ()
    frames: tuple[Label, ...] = ()
    capabilities: tuple[Label, ...] = ()
    streams: tuple[Stream, ...] = ()
    watchdog_ms: Milliseconds = 0
    max_loop_age_ms: Milliseconds = 0
    simulated: bool = False
    limits: tuple[Label, ...] = ()
    interlocks: tuple[InterlockRule, ...] = ()
    scripts: Literal["jailed", "trusted", "refused"] = "refused"
    scripts_note: Text = ""


class Geometry(Struct, frozen=True, kw_only=True):
    """One primitive shape of a body.

    ``size_m`` is as MuJoCo gives it: box half extents; sphere radius; capsule and
    cylinder radius, half length along z; ellipsoid radii; plane half extents.
    """

    shape: Literal["box", "sphere", "capsule", "cylinder", "ellipsoid", "plane"]
    size_m: Vector3
    position_m: Vector3
    quaternion: Quaternion
    rgba: Quaternion


class TwinJoint(Struct, frozen=True, kw_only=True):
    """The joint by which a body turns or slides: axis and anchor in the body's own frame."""

    name: Label
    kind: Literal["hinge", "slide"]
    axis: Vector3
    anchor_m: Vector3
    reference_rad: float = 0.0


class Body(Struct, frozen=True, kw_only=True):
    """One body of the tree; ``parent`` is its index in ``Twin.bodies``, -1 for a root."""

    name: Label
    parent: int
    position_m: Vector3
    quaternion: Quaternion
    joint: TwinJoint | None = None
    geometries: tuple[Geometry, ...] = ()


class Twin(Struct, frozen=True, kw_only=True):
    """``desc/twin``: the drawing from which a page builds its live view. Retained."""

    device: Id
    bodies: tuple[Body, ...]


class Mode(StrEnum):
    """What the device is doing at this moment."""

    IDLE = "idle"
    STREAMING = "streaming"
    ACTION = "action"
    HOLDING = "holding"
    STOPPED = "stopped"
    FAULT = "fault"


class StopLatch(Struct, frozen=True, kw_only=True):
    """Who stopped the device, and when. There until somebody who may resets it."""

    by: Label
    reason: Text
    at_ms: Milliseconds


class OpenRequest(Struct, frozen=True, kw_only=True):
    """Somebody asks the holder for control, and gets an answer in the time that is left or none."""

    id: Id
    by: Label
    expires_in_ms: Milliseconds


class LeaseState(Struct, frozen=True, kw_only=True):
    """The lease that the device obeys now.

    ``reason`` says why it was taken from somebody else, and is empty where it was not. ``request`` is for people:
    nothing about motion depends on it.
    """

    holder: Label
    epoch: Count
    expires_in_ms: Milliseconds
    reason: Text = ""
    request: OpenRequest | None = None


class ActionState(Struct, frozen=True, kw_only=True):
    """The action that the device runs now."""

    id: Id
    kind: Label
    name: Label = ""
    progress: float = 0.0


class Fault(Struct, frozen=True, kw_only=True):
    """Something wrong that lasts."""

    code: Label
    message: Text
    since_ms: Milliseconds


class Restriction(Struct, frozen=True, kw_only=True):
    """What the room allows at this moment: ``speed`` is the share that is left, 0: hold. ``source`` is an interlock."""

    source: Text
    speed: float
    why: Text


class State(Struct, frozen=True, kw_only=True):
    """``state``: the current condition. Retained; on change and every 30 s, at most once a second.

    ``ended_epoch`` is the highest epoch that the device will never obey again. It only rises, so even an old message
    tells the truth: a lease of such an epoch is nobody's any more.
    """

    device: Id
    at_ms: Milliseconds
    tick_ms: Milliseconds
    mode: Mode
    epoch: Count
    ended_epoch: Count = 0
    stop: StopLatch | None = None
    lease: LeaseState | None = None
    action: ActionState | None = None
    faults: tuple[Fault, ...] = ()
    restrictions: tuple[Restriction, ...] = ()


class JointTelemetry(Struct, frozen=True, kw_only=True):
    """``tele/joints``: all joints of one device at one tick, in the order of ``Description.joints``.

    ``epoch`` is that of the lease in force at the device, 0 when none is: whoever thinks to have control and reads 0
    has it no longer. ``setpoint_sequence`` is the newest setpoint the control loop has taken (0: none in this lease),
    and ``setpoint_sent_ms`` the operator's own clock in it, so that the page measures its round trip on one clock.
    ``limited`` names what changed a setpoint on its way to the motors.
    """

    tick_ms: Milliseconds
    at_ms: Milliseconds
    sequence: Count
    mode: Mode
    position_rad: tuple[float, ...]
    velocity_rad_s: tuple[float, ...]
    effort_nm: tuple[float, ...]
    commanded_rad: tuple[float, ...]
    frames: tuple[Pose, ...] = ()
    epoch: Count = 0
    setpoint_sequence: Count = 0
    setpoint_sent_ms: float = 0.0
    loop_age_ms: float = 0.0
    limited: tuple[Label, ...] = ()


class Measurements(Struct, frozen=True, kw_only=True):
    """``tele/{stream}``, every stream but ``joints``: named values, all measured at one moment.

    A name is a quantity with its unit, then a dot and the part of the device where there are several:
    ``temperature_c.elbow``. ``sequence`` counts up from one start of the agent to the next.
    """

    tick_ms: Milliseconds
    at_ms: Milliseconds
    sequence: Count
    values: Annotated[dict[Field, float | bool], Meta(min_length=1, max_length=MAX_VALUES)]


class Event(Struct, frozen=True, kw_only=True):
    """``event``: a fact that happened, in the past tense. Stored."""

    id: Id
    device: Id
    at_ms: Milliseconds
    kind: Label
    severity: Literal["info", "warning", "error"]
    message: Text
    data: dict[str, Any] = {}


class AckStatus(StrEnum):
    """How far a command has come. The last four are terminal."""

    RECEIVED = "received"
    ACCEPTED = "accepted"
    STARTED = "started"
    DONE = "done"
    FAILED = "failed"
    EXPIRED = "expired"
    CANCELLED = "cancelled"

    @property
    def terminal(self) -> bool:
        """Whether nothing follows."""
        return self in TERMINAL


TERMINAL = frozenset({AckStatus.DONE, AckStatus.FAILED, AckStatus.EXPIRED, AckStatus.CANCELLED})


class Reason(Struct, frozen=True, kw_only=True):
    """Why a command ended as it did: a code for programs, a sentence for people that says what to do."""

    code: Label
    message: Text


class Ack(Struct, frozen=True, kw_only=True):
    """``ack``: the device's answer to one command. ``sequence`` orders the acks of one command."""

    id: Id
    status: AckStatus
    sequence: Count
    at_ms: Milliseconds
    tick_ms: Milliseconds
    reason: Reason | None = None
    progress: float | None = None
    output: Text = ""
    result: dict[str, Any] = {}


# ---------------------------------------------------------------- → agent


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


class AskLease(_Order, frozen=True, kw_only=True, tag="ask_lease"):
    """Show the holder, and everybody, that somebody asks for control. Changes nothing else; lapses by itself."""

    request: Id
    by: Label
    answer_within_ms: Annotated[int, Meta(ge=1, le=3_600_000)]


class DropRequest(_Order, frozen=True, kw_only=True, tag="drop_request"):
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


class MoveJoints(_Order, frozen=True, kw_only=True, tag="move_joints"):
    """Move to joint positions and end there."""

    position_rad: JointPositions
    speed: Annotated[float, Meta(gt=0, le=1, description="share of each joint's velocity limit")] = 0.5


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


Request = (
    GrantLease
    | ReleaseLease
    | AskLease
    | DropRequest
    | RunMovement
    | MoveJoints
    | CancelAction
    | StopDevice
    | ResetStop
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
    who: Label
    epoch: Count
    request: Request


class JointTarget(_Order, frozen=True, kw_only=True, tag="joints"):
    """Go to these joint positions, as fast as limits allow."""

    position_rad: JointPositions


class Setpoint(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``ctl/{epoch}``: one streamed setpoint. The newest wins; ``sequence`` starts at 1 in each lease.

    ``echo_tick_ms`` is ``tick_ms`` of the last telemetry the operator saw: its age on the robot's own clock is the
    loop age. ``sent_ms`` is any clock of the operator's [ms]; telemetry echoes it.
    """

    epoch: Count
    sequence: Annotated[int, Meta(ge=1, le=2**53)]
    echo_tick_ms: Milliseconds
    sent_ms: float
    target: JointTarget


class Stop(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``stop``: latch Stop now. Needs no lease and no signature: the broker lets only those publish it who may."""

    id: Id
    by: Label
    reason: Text = ""


def schema_components() -> tuple[dict[str, Any], dict[str, Any]]:
    """JSON Schema of every message: ``(references by name, definitions)``, for the generated documents."""
    kinds = (Presence, Description, Twin, State, JointTelemetry, Measurements, Event, Ack, Command, Setpoint, Stop)
    references, definitions = msgspec.json.schema_components(kinds, ref_template="#/components/schemas/{name}")
    return dict(zip((kind.__name__ for kind in kinds), references, strict=True)), definitions
