"""Robot types and rooms: where their folders are, and what a device of ``agent.toml`` is by them."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from device_agent.config.agent_config import AgentConfig, DeviceEntry
from device_agent.config.errors import ConfigError
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import robot_type, room
from device_agent.protocol.manifests.shipped import ROBOTS

ROBOTS_PATH = "TELESCOPE_ROBOTS_PATH"
"""Environment: folders of other people's robot types, separated as those of ``PATH``."""

Manifest = TypeVar("Manifest")


@dataclass(frozen=True, kw_only=True, slots=True)
class Catalogue(Generic[Manifest]):
    """Folders of one kind, each with a manifest, in all ``places()``.

    Attributes:
        what: What they describe, for people.
        pattern: The manifests' paths in a place; ``*`` stands for the folder's name.
        read: Reads and checks the manifest of a folder, or raises ``ProtocolError``.
    """

    what: str
    pattern: str
    read: Callable[[Path], Manifest]

    def folders(self) -> dict[str, Path]:
        """Every name and its folder; of two with one name that of the earlier place."""
        found: dict[str, Path] = {}
        for place in places():
            for path in sorted(place.glob(self.pattern)):
                found.setdefault(path.parent.name, path.parent)
        return found

    def folder(self, name: str) -> Path:
        """The folder of this name.

        Raises:
            ConfigError: Unknown; the text lists the known ones.
        """
        known = self.folders()
        if name not in known:
            raise ConfigError(
                f"no {self.what} '{name}'; there are: {', '.join(known)}. Name the folder that holds yours in "
                f"{ROBOTS_PATH}, as {self.pattern.replace('*', name)}"
            )
        return known[name]

    def load(self, name: str) -> Manifest:
        """The manifest of this name.

        Raises:
            ConfigError: Unknown, or the manifest is wrong; the text lists the known ones.
        """
        return self.load_from(self.folder(name))

    def load_from(self, folder: Path) -> Manifest:
        """The manifest of any folder.

        Raises:
            ConfigError: It is missing or wrong.
        """
        try:
            return self.read(folder)
        except ProtocolError as error:
            raise ConfigError(str(error)) from error


TYPES = Catalogue(what="robot type", pattern=f"*/{robot_type.MANIFEST}", read=robot_type.load)
ROOMS = Catalogue(what="room", pattern=f"rooms/*/{room.MANIFEST}", read=room.load)


def places() -> tuple[Path, ...]:
    """The folders that hold robot types and rooms: this installation's, then those of ``TELESCOPE_ROBOTS_PATH``."""
    more = os.environ.get(ROBOTS_PATH, "").split(os.pathsep)
    return (ROBOTS, *(Path(place).expanduser().resolve() for place in more if place))


def type_of(entry: DeviceEntry) -> robot_type.RobotType:
    """The robot type of a configured device; of a room's device, what the room's manifest says of it.

    Raises:
        ConfigError: The type or room is unknown, or the room has nothing of that name and type.
    """
    if not entry.room:
        return TYPES.load(entry.type)
    there = ROOMS.load(entry.room)
    device, robot = there.device(entry.name), there.robot(entry.name)
    if device is None and robot is None:
        raise ConfigError(f"room '{entry.room}' has no '{entry.name}'; it has: {', '.join(there.names)}")
    kind = TYPES.load(robot.type) if robot is not None else device.robot_type()  # type: ignore[union-attr]
    if kind.type != entry.type:
        raise ConfigError(f"'{entry.name}' of room '{entry.room}' is a {kind.type}, not a {entry.type}")
    return kind


def room_device_of(entry: DeviceEntry) -> room.RoomDeviceManifest | None:
    """What the room's manifest says of a configured device; ``None`` where it is a robot.

    Raises:
        ConfigError: The room is unknown.
    """
    return ROOMS.load(entry.room).device(entry.name) if entry.room else None


def entries_of(name: str) -> list[DeviceEntry]:
    """What ``agent.toml`` says of all that is in a room.

    Raises:
        ConfigError: The room, or the type of a robot in it, is unknown.
    """
    there = ROOMS.load(name)
    robots = (
        DeviceEntry(name=robot.name, type=robot.type, room=name, label=robot.label or TYPES.load(robot.type).label)
        for robot in there.robots
    )
    devices = (DeviceEntry(name=each.name, type=each.kind, room=name, label=each.label) for each in there.devices)
    return [*robots, *devices]


def enrolled_devices(configuration: AgentConfig) -> list[dict[str, str]]:
    """The devices as the cloud is told of them.

    Raises:
        ConfigError: One is of an unknown type or room.
    """
    entries = []
    for device in configuration.devices:
        kind = type_of(device)
        entries.append(
            {"name": device.name, "kind": kind.kind, "robot_type": kind.type, "label": device.label or kind.label}
        )
    return entries
