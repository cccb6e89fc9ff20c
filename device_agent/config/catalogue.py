"""Finds the folders of robot types and rooms, and resolves device entries of ``agent.toml`` against them."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from device_agent.config.agent_config import AgentConfig, DeviceEntry
from device_agent.config.errors import ConfigError
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import robot_type, room, tasks
from device_agent.protocol.manifests.shipped import ROBOTS

ROBOTS_PATH = "TELESCOPE_ROBOTS_PATH"
"""Environment variable: additional search paths, separated as in ``PATH``."""

Manifest = TypeVar("Manifest")


@dataclass(frozen=True, kw_only=True, slots=True)
class Catalogue(Generic[Manifest]):
    """Folders of one kind, each with a manifest, in all search paths.

    Attributes:
        label: Content of a folder, for messages.
        pattern: Path of the manifest relative to a search path; ``*`` is the folder's name.
        read: Reads the manifest of a folder; raises ``ProtocolError``.
    """

    label: str
    pattern: str
    read: Callable[[Path], Manifest]

    def folders(self) -> dict[str, Path]:
        """All names and their folders; the first search path takes precedence."""
        folders: dict[str, Path] = {}
        for place in search_paths():
            for path in sorted(place.glob(self.pattern)):
                folders.setdefault(path.parent.name, path.parent)
        return folders

    def folder(self, name: str) -> Path:
        """The folder of this name.

        Raises:
            ConfigError: The name is unknown. The message lists the known names.
        """
        known = self.folders()
        if name not in known:
            raise ConfigError(
                f"no {self.label} '{name}'; known: {', '.join(known)}. To add your own, set {ROBOTS_PATH} to the "
                f"folder that contains {self.pattern.replace('*', name)}"
            )
        return known[name]

    def load(self, name: str) -> Manifest:
        """The manifest of this name.

        Raises:
            ConfigError: The name is unknown, or the manifest is wrong.
        """
        return self.load_from(self.folder(name))

    def load_from(self, folder: Path) -> Manifest:
        """The manifest of a folder.

        Raises:
            ConfigError: The manifest is missing or wrong.
        """
        try:
            return self.read(folder)
        except ProtocolError as error:
            raise ConfigError(str(error)) from error


TYPES = Catalogue(label="robot type", pattern=f"*/{robot_type.MANIFEST}", read=robot_type.load)
ROOMS = Catalogue(label="room", pattern=f"rooms/*/{room.MANIFEST}", read=room.load)


def search_paths() -> tuple[Path, ...]:
    """Search paths: the shipped folder, then those of ``TELESCOPE_ROBOTS_PATH``."""
    extra = os.environ.get(ROBOTS_PATH, "").split(os.pathsep)
    return (ROBOTS, *(Path(path).expanduser().resolve() for path in extra if path))


def add_search_path(folder: Path) -> None:
    """Add a search path after the others, for this process and its child processes."""
    paths = [path for path in os.environ.get(ROBOTS_PATH, "").split(os.pathsep) if path]
    if str(folder) not in paths:
        os.environ[ROBOTS_PATH] = os.pathsep.join([*paths, str(folder)])


def type_of(entry: DeviceEntry) -> robot_type.RobotType:
    """The robot type of a device entry; for a room device, derived from its description.

    Raises:
        ConfigError: The type or room is unknown, the room has no device of this name and type, or a room device has
            the type of a robot.
    """
    if entry.described:
        if entry.type in TYPES.folders():
            raise ConfigError(
                f"'{entry.name}' has streams or controls of its own, but '{entry.type}' is a robot type; "
                'use another `type`, for example "sensor"'
            )
        return entry.room_device().robot_type()
    if not entry.room:
        return TYPES.load(entry.type)
    manifest = ROOMS.load(entry.room)
    device, robot = manifest.device(entry.name), manifest.robot(entry.name)
    if device is None and robot is None:
        raise ConfigError(f"room '{entry.room}' has no '{entry.name}'; known: {', '.join(manifest.names)}")
    kind = TYPES.load(robot.type) if robot is not None else device.robot_type()  # type: ignore[union-attr]
    if kind.type != entry.type:
        raise ConfigError(f"'{entry.name}' of room '{entry.room}' is a {kind.type}, not a {entry.type}")
    return kind


def tasks_of(kind: robot_type.RobotType) -> tasks.Tasks | None:
    """Tasks of a robot type; ``None``: its folder has no manifest of tasks.

    Raises:
        ConfigError: The manifest is wrong.
    """
    folder = TYPES.folders().get(kind.type)
    try:
        return None if folder is None else tasks.load(folder / kind.scene)
    except ProtocolError as error:
        raise ConfigError(str(error)) from error


def room_device_of(entry: DeviceEntry) -> room.RoomDeviceManifest | None:
    """The description of a room device, from its entry or its room's manifest; ``None`` for a robot.

    Raises:
        ConfigError: The room is unknown.
    """
    if entry.described:
        return entry.room_device()
    return ROOMS.load(entry.room).device(entry.name) if entry.room else None


def downloadable(entry: DeviceEntry) -> bool:
    """Whether the type of a device is a robot type, which the cloud may provide."""
    return not entry.room and not entry.described


def entries_of(name: str) -> list[DeviceEntry]:
    """Device entries of all robots and devices of a room.

    Raises:
        ConfigError: The room, or the type of one of its robots, is unknown.
    """
    manifest = ROOMS.load(name)
    robots = (
        DeviceEntry(name=robot.name, type=robot.type, room=name, label=robot.label or TYPES.load(robot.type).label)
        for robot in manifest.robots
    )
    devices = (DeviceEntry(name=item.name, type=item.kind, room=name, label=item.label) for item in manifest.devices)
    return [*robots, *devices]


def enrolled_devices(configuration: AgentConfig) -> list[dict[str, str]]:
    """The devices as the cloud receives them at enrollment.

    The kind of a robot type that is not downloaded yet is ``robot``; it is corrected at the next connection.

    Raises:
        ConfigError: A room is unknown, or a manifest is wrong.
    """
    entries = []
    known = TYPES.folders()
    for device in configuration.devices:
        if downloadable(device) and device.type not in known:
            label = device.label or device.name
            entries.append({"name": device.name, "kind": "robot", "robot_type": device.type, "label": label})
            continue
        kind = type_of(device)
        entries.append(
            {"name": device.name, "kind": kind.kind, "robot_type": kind.type, "label": device.label or kind.label}
        )
    return entries
