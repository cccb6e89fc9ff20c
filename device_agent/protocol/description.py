"""What travels from an agent: what its devices are, how they are, what they measured, answered, and what happened.

Unknown fields pass, so that an old console still reads a newer robot.
"""

from bisect import bisect_right
from enum import StrEnum
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from device_agent.protocol.fields import (
    MAX_VALUES,
    Count,
    Field,
    Id,
    Label,
    Milliseconds,
    Pose,
    Quaternion,
    Text,
    Vector3,
)


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


class MimicJoint(Struct, frozen=True, kw_only=True):
    """One motor moves two joints.

    Attributes:
        joint: The one that only follows: at ``factor`` times the position of
        of: the joint that counts. Whoever names either moves both.
    """

    joint: Label
    mimics: Label
    multiplier: float = 1.0


class PositionDependentLimit(Struct, frozen=True, kw_only=True):
    """The range of one joint depends on where another one is.

    Attributes:
        joint: Whose range; ``by``: the other.
        table: Rows of ``by``'s position and the range there, lower and upper [rad]; linear in between. It reaches over
            all of ``by``'s range.
    """

    joint: Label
    depends_on: Label
    table: Annotated[tuple[Vector3, ...], Meta(min_length=2, max_length=200)]

    def at(self, by_rad: float) -> tuple[float, float]:
        """The range while ``by`` is there [rad]; beyond the table's ends that of its ends."""
        rows = self.table
        if by_rad <= rows[0][0]:
            return rows[0][1:]
        if by_rad >= rows[-1][0]:
            return rows[-1][1:]
        after = bisect_right(rows, by_rad, key=lambda row: row[0])
        (start, low, high), (end, next_low, next_high) = rows[after - 1], rows[after]
        share = (by_rad - start) / (end - start)
        return low + (next_low - low) * share, high + (next_high - high) * share


class BaseLimits(Struct, frozen=True, kw_only=True):
    """How fast a base may be driven: forward or back, to a side (0: it cannot), turning."""

    forward_m_s: float
    left_m_s: float
    turn_rad_s: float


class Stream(Struct, frozen=True, kw_only=True):
    """One stream at ``tele/{name}``: ``joints`` carries ``JointTelemetry``, all others ``Measurements``."""

    name: Id
    rate_hz: float


class Control(Struct, frozen=True, kw_only=True):
    """One thing that can be set, within ``lower`` and ``upper`` [``unit``]."""

    name: Id
    label: Label
    unit: Annotated[str, Meta(max_length=20)] = ""
    lower: float
    upper: float


class Diagnostic(Struct, frozen=True, kw_only=True):
    """How some measurements of a device are to be judged. Values in the measurement's own unit.

    Attributes:
        stream: The stream that carries them.
        fields: Their names; ``*`` stands for any text: ``temperature_c.*``.
        label: What is measured, for people; ``unit``: of the values.
        advice: What to do when something is wrong.
        low: Below this something breaks; ``high``: above.
        warning_low: Below this somebody should look; ``warning_high``: above.
        change: A lasting shift that is worth a word; without it half of the room to the limits.
        horizon_s: How long before a limit a trend towards it is told [s].
        questions: What to look for: ``level``, ``trend``, ``change``, ``outlier``; none: nothing there is unusual.
    """

    stream: Id = "health"
    fields: Annotated[str, Meta(min_length=1, max_length=200)]
    label: Label
    unit: Annotated[str, Meta(max_length=20)] = ""
    advice: Annotated[str, Meta(max_length=500)] = ""
    low: float | None = None
    high: float | None = None
    warning_low: float | None = None
    warning_high: float | None = None
    change: Annotated[float, Meta(gt=0)] | None = None
    horizon_s: Annotated[float, Meta(ge=60, le=86_400)] = 2_700.0
    checks: tuple[Label, ...] = ("level", "trend", "change", "outlier")


class InterlockDescription(Struct, frozen=True, kw_only=True):
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

    ``actions`` names the kinds of action that it takes; ``postures``, ``expressions`` and ``behaviours`` what those of
    these kinds may name. An agent that names no actions is an older one.
    ``mirrors`` and ``narrowing``: how its joints hang together.
    ``cameras``: what ``cam/{name}`` shows; ``captures``: what raw data can be had; ``controls``: what can be set.

    ``diagnostics``: how what it measures is to be judged, where that is said by no robot type, but by its room.
    ``position_m``: where a room device is, in its room's frame; of a robot its room tells (``positions``).
    ``base``: the limits of one that drives or walks; missing where it stays in its place.

    ``scripts``: movement scripts run in the jail, run with less (``trusted``, as the agent's owner wants it), or are
    refused; ``scripts_note`` says why, and what to do.
    """

    device: Id
    kind: Label
    robot_type: Id
    label: Label
    joints: tuple[Joint, ...] = ()
    mimic_joints: tuple[MimicJoint, ...] = ()
    position_dependent_limits: tuple[PositionDependentLimit, ...] = ()
    frames: tuple[Label, ...] = ()
    capabilities: tuple[Label, ...] = ()
    actions: tuple[Label, ...] = ()
    postures: tuple[Label, ...] = ()
    expressions: tuple[Label, ...] = ()
    behaviours: tuple[Label, ...] = ()
    streams: tuple[Stream, ...] = ()
    cameras: tuple[Stream, ...] = ()
    captures: tuple[Label, ...] = ()
    controls: tuple[Control, ...] = ()
    watchdog_ms: Milliseconds = 0
    max_loop_age_ms: Milliseconds = 0
    simulated: bool = False
    limits: tuple[Label, ...] = ()
    interlocks: tuple[InterlockDescription, ...] = ()
    diagnostics: Annotated[tuple[Diagnostic, ...], Meta(max_length=100)] = ()
    position_m: Vector3 | None = None
    base: BaseLimits | None = None
    scripts: Literal["sandboxed", "unconfined", "unavailable"] = "unavailable"
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
    """The joint by which a body turns or slides: axis and anchor in the body's own frame.

    One that ``follows`` others has no motor of its own: its position is the sum of factor times position of those.
    """

    name: Label
    kind: Literal["hinge", "slide"]
    axis: Vector3
    anchor_m: Vector3
    reference_rad: float = 0.0
    follows: dict[Label, float] = {}


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

    caller: Label
    reason: Text
    at_ms: Milliseconds


class OpenRequest(Struct, frozen=True, kw_only=True):
    """Somebody asks the holder for control, and gets an answer in the time that is left or none."""

    id: Id
    requester: Label
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
    reason: Text


class State(Struct, frozen=True, kw_only=True):
    """``state``: the current condition. Retained; on change and every 30 s, at most once a second.

    ``ended_epoch`` is the highest epoch that the device will never obey again. It only rises, so even an old message
    tells the truth: a lease of such an epoch is nobody's any more. ``stiffness`` names the joints that hold with less
    than all their strength, and with which share of it.
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
    stiffness: dict[str, float] = {}


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
