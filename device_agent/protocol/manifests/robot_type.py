"""Manifest of a robot type, ``robots/<type>/robot.toml``; read by agents (limits, model) and the cloud (catalogue)."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, Struct

from device_agent.protocol import CameraStream, Id, Joint, Label, Stream, Text, Vector3, camera_frames, description
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import capabilities, toml

MANIFEST = "robot.toml"
MOVEMENTS = "movements"
MAX_PERIOD_MS = 1000
MAX_CAMERA_HZ = 10.0
"""Maximum frame rate of a robot's camera [Hz]. Frames share link and processor with motion control."""
MAX_JOINTS = 128
"""Maximum number of joints in ``JointPositions``."""


class Diagnostic(description.Diagnostic, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Diagnostic of a manifest; see ``description.Diagnostic``."""

    checks: tuple[Literal["level", "trend", "change", "outlier"], ...] = ("level", "trend", "change", "outlier")


class Workspace(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Box in the robot's base frame that some frames never leave.

    Attributes:
        lower_m: Lowest corner [m].
        upper_m: Highest corner [m].
        frames: Frames that stay inside.
    """

    lower_m: Vector3
    upper_m: Vector3
    frames: Annotated[tuple[Label, ...], Meta(min_length=1)]


class Base(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Limits of a mobile base.

    Attributes:
        max_linear_m_s: Maximum speed in each direction [m/s].
        max_angular_rad_s: Maximum turning speed [rad/s].
        max_linear_acceleration_m_s2: Maximum acceleration [m/s²].
        max_angular_acceleration_rad_s2: Maximum angular acceleration [rad/s²].
        braking_linear_m_s2: Deceleration for a hold or a Stop [m/s²].
        braking_angular_rad_s2: Angular deceleration for a hold or a Stop [rad/s²].
        radius_m: Radius of the base including the clearance for navigation [m].
        sideways: Whether the base moves sideways, as legs and omnidirectional wheels do.
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
    """Frames and joints with which the robot looks at a point.

    Attributes:
        frame: Frame of a camera or a face, one of the type's ``frames``.
        additional_frames: Frames that look at the same point, for example the other eye. Each needs a joint of its own.
        axis: Viewing direction in each of these frames.
        joints: Joints that turn the gaze.
    """

    frame: Label
    additional_frames: Annotated[tuple[Label, ...], Meta(max_length=3)] = ()
    axis: Vector3 = (1.0, 0.0, 0.0)
    joints: Annotated[tuple[Label, ...], Meta(min_length=1)]


class RobotType(capabilities.Capabilities, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Properties of all robots of one type, including ``Capabilities``.

    Attributes:
        type: Id of the type, equal to the folder's name.
        version: Rises with each change that affects robots or movements.
        model: MJCF file of the robot alone, relative to the folder.
        scene: MJCF file of the robot in a small world.
        driver: Driver used if the agent's configuration names none.
        period_ms: Control period [ms].
        joints: Joints in the order of the telemetry, named as in the model.
        frames: Sites or bodies of the model whose pose telemetry includes.
        home_rad: Start position: joint name → position [rad].
        braking_rad_s2: Deceleration of every joint for a hold or a Stop [rad/s²]; above ``max_acceleration_rad_s2``.
        diagnostics: How the cloud evaluates measurements; the first match of a field applies.
        cameras: Cameras and their frame rates, at most ``MAX_CAMERA_HZ``. A simulated model has cameras of these names.
        streaming_speed: Share of each joint's velocity limit for streamed setpoints, 0…1.
        margin_m: Minimum clearance to itself and to obstacles [m].
        workspace: Box that some frames never leave.
        base: Limits of a mobile base; ``None`` for a fixed robot.
        gaze: Frames and joints of the gaze.
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
    cameras: Annotated[tuple[CameraStream, ...], Meta(max_length=4)] = ()
    diagnostics: Annotated[tuple[Diagnostic, ...], Meta(max_length=100)] = ()


def load(folder: Path) -> RobotType:
    """Read and check the manifest of a robot type's folder.

    Raises:
        ProtocolError: The manifest is missing or wrong. The message names file and field.
    """
    return toml.load(folder / MANIFEST, parse, named="type")


def parse(text: str) -> RobotType:
    """Parse a manifest from TOML text.

    Raises:
        ProtocolError: The text is not TOML, a field is wrong, or fields contradict each other.
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
    capabilities.check(robot_type, robot_type.joints, robot_type.home_rad)
    if robot_type.gaze is not None:
        _check_gaze(robot_type.gaze, robot_type)
    check_diagnostics(robot_type.diagnostics)
    return robot_type


def check_diagnostics(diagnostics: Sequence[Diagnostic]) -> None:
    """Require finite limits in ascending order.

    Raises:
        ProtocolError: The limits are not. The message names the fields.
    """
    for diagnostic in diagnostics:
        values = (diagnostic.low, diagnostic.warning_low, diagnostic.warning_high, diagnostic.high)
        limits = [limit for limit in values if limit is not None]
        if not all(math.isfinite(limit) for limit in limits) or limits != sorted(limits):
            raise ProtocolError(f"diagnostics of '{diagnostic.fields}': low, warning_low, warning_high, high must rise")


def _check_figures(robot_type: RobotType) -> None:
    """Reject limits that cannot be controlled."""
    if not 1 <= robot_type.period_ms <= MAX_PERIOD_MS:
        raise ProtocolError(f"period_ms is {robot_type.period_ms}; it must be 1 to {MAX_PERIOD_MS}")
    if len(robot_type.joints) > MAX_JOINTS:
        raise ProtocolError(f"{len(robot_type.joints)} joints; the limit is {MAX_JOINTS}")
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


def _check_cameras(cameras: Sequence[CameraStream]) -> None:
    if len({camera.name for camera in cameras}) != len(cameras):
        raise ProtocolError("two cameras have the same name")
    for camera in cameras:
        if camera.kind != camera_frames.COLOUR:
            raise ProtocolError(
                f"camera '{camera.name}': kind is '{camera.kind}'; cameras of robots have '{camera_frames.COLOUR}'. "
                "Describe other sensors as room devices"
            )
        toml.check_positive(f"rate_hz of camera '{camera.name}'", camera.rate_hz)
        if camera.rate_hz > MAX_CAMERA_HZ:
            raise ProtocolError(
                f"camera '{camera.name}': rate_hz is {camera.rate_hz:g}; the limit is {MAX_CAMERA_HZ:g}"
            )


def _check_workspace(box: Workspace, robot_type: RobotType) -> None:
    toml.check_box("workspace", box.lower_m, box.upper_m)
    toml.check_known("workspace", "frame", box.frames, robot_type.frames)
    if not robot_type.model:
        raise ProtocolError("workspace needs a model, which determines the position of frames")


def _check_gaze(gaze: Gaze, robot_type: RobotType) -> None:
    toml.check_known("gaze", "frame", (gaze.frame, *gaze.additional_frames), robot_type.frames)
    toml.check_known("gaze", "joint", gaze.joints, [joint.name for joint in robot_type.joints])
    if not 0 < math.hypot(*gaze.axis) < math.inf:
        raise ProtocolError("gaze: axis must have finite numbers that are not all 0")


def _check_positive(holder: Struct, fields: Sequence[str], where: str) -> None:
    for field in fields:
        toml.check_positive(f"{field}{where}", getattr(holder, field))
