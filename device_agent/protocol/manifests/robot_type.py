"""A robot type's manifest, ``robots/<type>/robot.toml``: read by agents (limits, model) and the cloud (catalogue)."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, Struct

from device_agent.protocol import Id, Joint, Label, Stream, Text, Vector3
from device_agent.protocol import description as reports
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import capabilities as abilities
from device_agent.protocol.manifests import toml

MANIFEST = "robot.toml"
MOVEMENTS = "movements"
MAX_PERIOD_MS = 1000
MOST_PICTURES_HZ = 10.0
"""Of one camera of a robot: pictures are for people, and take the link and the machine from what moves it."""
MAX_JOINTS = 128
"""Most that a ``JointPositions`` names."""


class Diagnostic(reports.Diagnostic, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How some measurements are to be judged, as a manifest says it."""

    checks: tuple[Literal["level", "trend", "change", "outlier"], ...] = ("level", "trend", "change", "outlier")


class Workspace(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A box in the robot's base frame that some of its frames never leave.

    Attributes:
        lower_m: The box's lowest corner; ``upper_m``: its highest [m].
        frames: The frames that stay inside.
    """

    lower_m: Vector3
    upper_m: Vector3
    frames: Annotated[tuple[Label, ...], Meta(min_length=1)]


class Base(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a robot that drives or walks can do.

    Attributes:
        max_linear_m_s: Speed over the floor, in each direction [m/s].
        max_angular_rad_s: Turning [rad/s].
        max_linear_acceleration_m_s2: When speeding up [m/s²]; ``max_angular_acceleration_rad_s2``: the same of turning.
        braking_linear_m_s2: For a hold or a Stop [m/s²]; ``braking_angular_rad_s2``: the same of turning.
        radius_m: How far it reaches from its middle, with the room it wants to keep on its way [m].
        sideways: Whether it goes sideways, as legs and some wheels do.
    """

    max_linear_m_s: float
    max_angular_rad_s: float
    max_linear_acceleration_m_s2: float
    max_angular_acceleration_rad_s2: float
    braking_linear_m_s2: float
    braking_angular_rad_s2: float
    radius_m: float = 0.25
    sideways: bool = False


class Gaze(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a robot looks with.

    Attributes:
        frame: One of the type's ``frames``: of a camera, of a face.
        also: More such frames, that look at the same point: the other eye. Each needs a joint of its own.
        axis: The direction in which it looks, in each of these frames.
        joints: Those that turn it.
    """

    frame: Label
    also: Annotated[tuple[Label, ...], Meta(max_length=3)] = ()
    axis: Vector3 = (1.0, 0.0, 0.0)
    joints: Annotated[tuple[Label, ...], Meta(min_length=1)]


class RobotType(abilities.Abilities, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What every robot of one type has in common; with what ``Abilities`` lists.

    Attributes:
        type: Id of the type, the folder's name.
        version: Rises with each change that robots or movements could notice.
        model: MJCF file of the robot alone, relative to the folder.
        scene: MJCF file of the robot in a small world of its own.
        driver: Name of the driver that runs it when the agent's configuration names none.
        period_ms: Control period [ms].
        joints: In the order in which telemetry lists them; names are those of the model's joints and actuators.
        frames: Names of sites or bodies of the model whose pose telemetry carries.
        home_rad: Joint name → position [rad] at start.
        braking_rad_s2: Deceleration for a hold or a Stop [rad/s²], every joint; above ``max_acceleration_rad_s2``.
        diagnostics: How its measurements are to be judged; the first that fits a field counts.
        cameras: What it sees through, and how many pictures a second, at most ``MOST_PICTURES_HZ``. A simulated robot's
            model has cameras of these names.
        streaming_speed: Share of each joint's velocity limit that streamed setpoints may use, 0…1.
        margin_m: How near the robot may come to itself and to what stands around it [m].
        workspace: Where some of its frames stay.
        base: What it can do when it drives or walks; without it, it stays where it is.
        gaze: What it looks with, where that is turned by joints.
    """

    type: Id
    label: Label
    kind: Label
    version: int
    description: Text
    model: str
    scene: str
    driver: Id
    period_ms: int
    joints: tuple[Joint, ...]
    frames: tuple[Label, ...]
    home_rad: dict[str, float]
    braking_rad_s2: float
    streaming_speed: float = 0.35
    margin_m: float = 0.02
    workspace: Workspace | None = None
    base: Base | None = None
    gaze: Gaze | None = None
    capabilities: tuple[Label, ...] = ()
    streams: tuple[Stream, ...] = ()
    cameras: Annotated[tuple[Stream, ...], Meta(max_length=4)] = ()
    diagnostics: Annotated[tuple[Diagnostic, ...], Meta(max_length=100)] = ()


def load(folder: Path) -> RobotType:
    """Read and check the manifest of a robot folder.

    Raises:
        ProtocolError: Missing, not TOML, or a field is wrong; the text names file and field.
    """
    return toml.load(folder / MANIFEST, parse, named="type")


def parse(text: str) -> RobotType:
    """Read a manifest from TOML text.

    Raises:
        ProtocolError: Not TOML, a field is wrong, or fields contradict each other.
    """
    robot_type = toml.convert(text, RobotType)
    _check_figures(robot_type)
    names = [joint.name for joint in robot_type.joints]
    if len(set(names)) != len(names):
        raise ProtocolError("two joints have the same name")
    if set(robot_type.home_rad) != set(names):
        raise ProtocolError(f"home_rad must name every joint once: {', '.join(names)}")
    for joint in robot_type.joints:
        if not joint.lower_rad <= robot_type.home_rad[joint.name] <= joint.upper_rad:
            raise ProtocolError(f"home_rad of '{joint.name}' is outside its range")
    abilities.check(robot_type, robot_type.joints, robot_type.home_rad)
    if robot_type.gaze is not None:
        _check_gaze(robot_type.gaze, robot_type)
    check_diagnostics(robot_type.diagnostics)
    return robot_type


def check_diagnostics(diagnostics: Sequence[Diagnostic]) -> None:
    """Refuse limits that contradict each other.

    Raises:
        ProtocolError: They are not finite, or do not rise; the text names the fields.
    """
    for diagnostic in diagnostics:
        given = (diagnostic.low, diagnostic.warning_low, diagnostic.warning_high, diagnostic.high)
        limits = [limit for limit in given if limit is not None]
        if not all(math.isfinite(limit) for limit in limits) or limits != sorted(limits):
            raise ProtocolError(f"diagnostics of '{diagnostic.fields}': low, warning_low, warning_high, high must rise")


def _check_figures(robot_type: RobotType) -> None:
    """Refuse figures with which nothing could be controlled."""
    if not 1 <= robot_type.period_ms <= MAX_PERIOD_MS:
        raise ProtocolError(f"period_ms is {robot_type.period_ms}; it must be 1 to {MAX_PERIOD_MS}")
    if len(robot_type.joints) > MAX_JOINTS:
        raise ProtocolError(f"{len(robot_type.joints)} joints; {MAX_JOINTS} is the most")
    if not 0 < robot_type.streaming_speed <= 1:
        raise ProtocolError(f"streaming_speed is {robot_type.streaming_speed}; it must be above 0 and at most 1")
    toml.check_positive("braking_rad_s2", robot_type.braking_rad_s2)
    limits = ("max_velocity_rad_s", "max_acceleration_rad_s2", "max_jerk_rad_s3", "max_effort_nm")
    for joint in robot_type.joints:
        _check_positive(joint, limits, f" of '{joint.name}'")
        if not -math.inf < joint.lower_rad < joint.upper_rad < math.inf:
            raise ProtocolError(f"lower_rad of '{joint.name}' must be below its upper_rad, and both finite")
    if not 0 <= robot_type.margin_m < math.inf:
        raise ProtocolError(f"margin_m is {robot_type.margin_m}; it must be at least 0 and finite")
    if robot_type.workspace is not None:
        _check_workspace(robot_type.workspace, robot_type)
    if robot_type.base is not None:
        _check_positive(robot_type.base, [field for field in Base.__struct_fields__ if field != "sideways"], " of base")
    for stream in robot_type.streams:
        toml.check_positive(f"rate_hz of stream '{stream.name}'", stream.rate_hz)
    _check_cameras(robot_type.cameras)


def _check_cameras(cameras: Sequence[Stream]) -> None:
    if len({camera.name for camera in cameras}) != len(cameras):
        raise ProtocolError("two cameras have the same name")
    for camera in cameras:
        toml.check_positive(f"rate_hz of camera '{camera.name}'", camera.rate_hz)
        if camera.rate_hz > MOST_PICTURES_HZ:
            raise ProtocolError(
                f"camera '{camera.name}': {camera.rate_hz:g} pictures a second; {MOST_PICTURES_HZ:g} is the most"
            )


def _check_workspace(box: Workspace, robot_type: RobotType) -> None:
    toml.check_box("workspace", box.lower_m, box.upper_m)
    toml.check_known("workspace", "frame", box.frames, robot_type.frames)
    if not robot_type.model:
        raise ProtocolError("workspace needs a model: without one nobody knows where a frame is")


def _check_gaze(gaze: Gaze, robot_type: RobotType) -> None:
    toml.check_known("gaze", "frame", (gaze.frame, *gaze.also), robot_type.frames)
    toml.check_known("gaze", "joint", gaze.joints, [joint.name for joint in robot_type.joints])
    if not 0 < math.hypot(*gaze.axis) < math.inf:
        raise ProtocolError("gaze: axis must be a direction, with finite numbers that are not all 0")


def _check_positive(holder: Struct, fields: Sequence[str], where: str) -> None:
    for field in fields:
        toml.check_positive(f"{field}{where}", getattr(holder, field))
