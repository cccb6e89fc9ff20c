"""A robot type's manifest, ``robots/<type>/robot.toml``: read by agents (limits, model) and the cloud (catalogue)."""

from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.messages import Id, Joint, Label, Stream, Text

MANIFEST = "robot.toml"
MOVEMENTS = "movements"


class RobotType(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What every robot of one type has in common.

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
        streaming_speed: Share of each joint's velocity limit that streamed setpoints may use, 0…1.
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
    capabilities: tuple[Label, ...] = ()
    streams: tuple[Stream, ...] = ()


def load(folder: Path) -> RobotType:
    """Read and check the manifest of a robot folder.

    Raises:
        ProtocolError: Missing, not TOML, or a field is wrong; the text names file and field.
    """
    path = folder / MANIFEST
    try:
        robot_type = parse(path.read_text(encoding="utf-8"))
    except (OSError, ProtocolError) as error:
        raise ProtocolError(f"{path}: {error}") from error
    if robot_type.type != folder.name:
        raise ProtocolError(f"{path}: type '{robot_type.type}' must equal the folder's name '{folder.name}'")
    return robot_type


def parse(text: str) -> RobotType:
    """Read a manifest from TOML text.

    Raises:
        ProtocolError: Not TOML, a field is wrong, or fields contradict each other.
    """
    import tomllib  # noqa: PLC0415 (15 ms of regular expressions, for who reads a manifest only)

    try:
        raw: dict[str, Any] = tomllib.loads(text)
        robot_type = msgspec.convert(raw, RobotType, strict=False)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise ProtocolError(str(error)) from error
    names = [joint.name for joint in robot_type.joints]
    if len(set(names)) != len(names):
        raise ProtocolError("two joints have the same name")
    if set(robot_type.home_rad) != set(names):
        raise ProtocolError(f"home_rad must name every joint once: {', '.join(names)}")
    for joint in robot_type.joints:
        if not joint.lower_rad <= robot_type.home_rad[joint.name] <= joint.upper_rad:
            raise ProtocolError(f"home_rad of '{joint.name}' is outside its range")
    return robot_type
