"""``desc`` and ``desc/twin``: what a device is and can do. Readers ignore unknown fields."""

from bisect import bisect_right
from typing import Annotated, Literal

from msgspec import Meta, Struct

from device_agent.protocol.fields import Id, Label, Milliseconds, Quaternion, Text, Vector3


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
    """A joint that follows another joint, because one motor moves both. A command for either joint moves both.

    Attributes:
        joint: The joint that follows.
        mimics: The joint that it follows.
        multiplier: Position of ``joint`` divided by the position of ``mimics``.
    """

    joint: Label
    mimics: Label
    multiplier: float = 1.0


class PositionDependentLimit(Struct, frozen=True, kw_only=True):
    """The range of one joint depends on the position of another joint.

    Attributes:
        joint: The joint with the variable range.
        depends_on: The joint that determines the range.
        table: Rows of the position of ``depends_on`` and the lower and upper limit there [rad], interpolated linearly.
            The rows cover the whole range of ``depends_on``.
    """

    joint: Label
    depends_on: Label
    table: Annotated[tuple[Vector3, ...], Meta(min_length=2, max_length=200)]

    def at(self, position_rad: float) -> tuple[float, float]:
        """The range for a position of ``depends_on`` [rad]; constant beyond the ends of the table."""
        rows = self.table
        if position_rad <= rows[0][0]:
            return rows[0][1:]
        if position_rad >= rows[-1][0]:
            return rows[-1][1:]
        after = bisect_right(rows, position_rad, key=lambda row: row[0])
        (start, low, high), (end, next_low, next_high) = rows[after - 1], rows[after]
        share = (position_rad - start) / (end - start)
        return low + (next_low - low) * share, high + (next_high - high) * share


class BaseLimits(Struct, frozen=True, kw_only=True):
    """Speed limits of a mobile base: forwards and backwards, sideways (0: not possible) and turning."""

    forward_m_s: float
    left_m_s: float
    turn_rad_s: float


class Stream(Struct, frozen=True, kw_only=True):
    """A stream at ``tele/{name}``: ``joints`` carries ``JointTelemetry``, all others ``Measurements``."""

    name: Id
    rate_hz: float


class CameraStream(Stream, frozen=True, kw_only=True):
    """A stream of frames at ``cam/{name}``.

    Attributes:
        kind: Content of the frames, one of ``camera_frames.KINDS``: ``colour``, ``depth``, ``scan`` or ``people``.
            Receivers ignore streams of unknown kinds.
    """

    kind: Label = "colour"


class Control(Struct, frozen=True, kw_only=True):
    """A value that can be set, between ``lower`` and ``upper`` [``unit``]."""

    name: Id
    label: Label
    unit: Annotated[str, Meta(max_length=20)] = ""
    lower: float
    upper: float


class RobotBehaviour(Struct, frozen=True, kw_only=True):
    """A behaviour that the robot itself provides. It moves its joints without the agent's limits.

    Attributes:
        name: Name for ``run_behaviour``; also listed in ``behaviours``.
        label: The robot's own name of it.
        recovery: Whether it removes a fault. It moves no joints, and may be started while Stop is latched.
    """

    name: Id
    label: Label
    recovery: bool = False


class Diagnostic(Struct, frozen=True, kw_only=True):
    """How the cloud evaluates measurements of a device. Limits are in the measurement's own unit.

    Attributes:
        stream: Stream of the measurements.
        fields: Names of the measurements; ``*`` matches any text: ``temperature_c.*``.
        label: Display name of the quantity.
        unit: Unit of the values.
        advice: What to do when a check fails.
        low: Values below are an error.
        high: Values above are an error.
        warning_low: Values below are a warning.
        warning_high: Values above are a warning.
        change: Lasting shift that is reported; ``None``: half of the distance to the limits.
        horizon_s: A trend is reported this long before it reaches a limit [s].
        checks: Checks to run: ``level``, ``trend``, ``change``, ``outlier``; empty: no value is unusual.
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
    """An interlock: the room slows or holds the device on a condition, or if its sensor is silent for ``stale_ms``.

    Attributes:
        name: Device, stream and condition.
        speed: Remaining share of the speed limits; 0 for ``hold``.
    """

    name: Text
    action: Literal["slow", "hold"]
    speed: float
    stale_ms: Milliseconds


class Description(Struct, frozen=True, kw_only=True):
    """``desc``: what the device is and can do. Retained.

    Attributes:
        mimic_joints: Joints that follow other joints.
        position_dependent_limits: Joint ranges that depend on other joints.
        actions: Kinds of actions that the device accepts. ``postures``, ``expressions`` and ``behaviours`` list the
            names that such actions may use. Empty for older agents.
        robot_behaviours: Those of the ``behaviours`` that the robot itself provides.
        cameras: Streams of frames at ``cam/{name}``, each of one kind.
        captures: Raw data that can be captured.
        controls: Values that can be set.
        limits: Limits that the agent enforces for every command source. ``clearance`` and ``workspace`` are absent if
            the shape of the robot is unknown.
        diagnostics: How the cloud evaluates the measurements of a room device; for robots, see the robot type.
        position_m: Position of a room device in the room; the stream ``positions`` of the room reports robots.
        base: Limits of a mobile base; ``None`` for a fixed robot.
        streaming: Whether setpoints reach the device. ``False``: the agent polls over HTTP; use actions instead.
        scripts: ``sandboxed``: movement scripts run confined. ``unconfined``: they run with fewer layers, as the
            agent's owner allows. ``unavailable``: they are rejected.
        scripts_note: Why scripts are not sandboxed, and the remedy.
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
    robot_behaviours: Annotated[tuple[RobotBehaviour, ...], Meta(max_length=128)] = ()
    streams: tuple[Stream, ...] = ()
    cameras: tuple[CameraStream, ...] = ()
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
    streaming: bool = True
    scripts: Literal["sandboxed", "unconfined", "unavailable"] = "unavailable"
    scripts_note: Text = ""


class Geometry(Struct, frozen=True, kw_only=True):
    """One primitive shape of a body.

    ``size_m`` follows MuJoCo: half extents of a box; radius of a sphere; radius and half length along z of a capsule
    or cylinder; radii of an ellipsoid; half extents of a plane.
    """

    shape: Literal["box", "sphere", "capsule", "cylinder", "ellipsoid", "plane"]
    size_m: Vector3
    position_m: Vector3
    quaternion: Quaternion
    rgba: Quaternion


class TwinJoint(Struct, frozen=True, kw_only=True):
    """The joint that moves a body relative to its parent. Axis and anchor are in the body's own frame.

    A joint that ``follows`` others has no motor: its position is the sum of multiplier times position of those joints.
    """

    name: Label
    kind: Literal["hinge", "slide"]
    axis: Vector3
    anchor_m: Vector3
    reference_rad: float = 0.0
    follows: dict[Label, float] = {}


class Body(Struct, frozen=True, kw_only=True):
    """One body of the tree. ``parent`` is its index in ``Twin.bodies``, -1 for a root."""

    name: Label
    parent: int
    position_m: Vector3
    quaternion: Quaternion
    joint: TwinJoint | None = None
    geometries: tuple[Geometry, ...] = ()


class Twin(Struct, frozen=True, kw_only=True):
    """``desc/twin``: the model from which the console draws the live view. Retained."""

    device: Id
    bodies: tuple[Body, ...]
