"""Settings of ``agent.toml``."""

import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import replace

from device_agent.config import private_file
from device_agent.config.errors import ConfigError
from device_agent.config.interlock_rule import InterlockRule
from device_agent.protocol import CameraStream, Id, Label, Stream, Vector3
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import room as rooms
from device_agent.protocol.manifests.robot_type import Diagnostic
from device_agent.protocol.manifests.room import Control, RoomDeviceManifest, Watch

CONFIG_FILE = "agent.toml"


class DeviceEntry(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One ``[[devices]]`` of ``agent.toml``.

    A room device that no room manifest describes is described here, with the fields of ``RoomDeviceManifest``.

    Attributes:
        name: Name of the device, unique at this agent.
        type: Robot type; for a room device its kind, for example ``thermometer``.
        room: Room whose manifest lists a robot or device of the same name and type; empty for none.
        driver: Driver name; empty for the driver of the robot type.
        label: Display name; empty for the label of the robot type.
        options: Options of the driver.
        interlocks: Interlocks of the device.
        streams: As in ``RoomDeviceManifest``, and so are the following.
    """

    name: Id
    type: Id
    room: str = ""
    driver: str = ""
    label: Label = ""
    options: dict[str, Any] = {}
    interlocks: Annotated[tuple[InterlockRule, ...], Meta(max_length=32)] = ()
    streams: Annotated[tuple[Stream, ...], Meta(max_length=16)] = ()
    cameras: Annotated[tuple[CameraStream, ...], Meta(max_length=4)] = ()
    captures: Annotated[tuple[Id, ...], Meta(max_length=16)] = ()
    controls: Annotated[tuple[Control, ...], Meta(max_length=16)] = ()
    diagnostics: Annotated[tuple[Diagnostic, ...], Meta(max_length=32)] = ()
    watch: Annotated[tuple[Watch, ...], Meta(max_length=20)] = ()
    position_m: Vector3 = (0.0, 0.0, 0.0)

    @property
    def described(self) -> bool:
        """Whether the entry itself describes a room device."""
        return bool(self.streams or self.cameras or self.captures or self.controls)

    def room_device(self) -> RoomDeviceManifest:
        """The room device that the entry describes."""
        return RoomDeviceManifest(
            name=self.name,
            kind=self.type,
            label=self.label or self.name,
            driver=self.driver,
            options=self.options,
            **{field: getattr(self, field) for field in _DESCRIPTION},
        )

    def lines(self) -> list[str]:
        """The lines of this entry in ``agent.toml``."""
        lines = ["[[devices]]"]
        lines += [f"{key} = {_toml(getattr(self, key))}" for key in ("name", "type", "driver", "label")]
        if self.room:
            lines.append(f"room = {_toml(self.room)}")
        if self.described:
            fields = msgspec.to_builtins({field: getattr(self, field) for field in _DESCRIPTION})
            lines += [f"{key} = {_toml(value)}" for key, value in fields.items() if any(value)]  # others: the default
        if self.options:
            lines.append("[devices.options]")
            lines += [f"{_toml(key)} = {_toml(value)}" for key, value in self.options.items()]
        for rule in self.interlocks:
            lines += ["", "[[devices.interlocks]]", *_table(rule)]
        return lines


_DESCRIPTION = ("streams", "cameras", "captures", "controls", "diagnostics", "watch", "position_m")
"""Fields of a device entry that describe a room device."""


class RoomStream(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One ``[[room]]`` of ``agent.toml``: a stream of the space that movement scripts may read.

    Attributes:
        device: Device id as the console shows it, or the name of a device of this agent.
        stream: Stream of that device.
    """

    device: Id
    stream: Id


class HttpPolling(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[http]`` of ``agent.toml``: how the ``http`` transport polls for commands.

    Attributes:
        poll: ``long``: the cloud responds when a command arrives. ``plain``: it responds immediately.
        poll_ms: Interval of plain polls [ms].
    """

    poll: Literal["long", "plain"] = "long"
    poll_ms: Annotated[int, Meta(ge=50, le=10_000)] = 1000


class Buffer(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[buffer]`` of ``agent.toml``: what the agent stores on disk while the link is down.

    Attributes:
        max_mb: Size limit [MB]. The oldest entries are dropped first.
        max_age_h: Age limit of measurements [h]. The cloud rejects measurements older than one day.
        measurements_hz: Stored measurements per stream [Hz].
    """

    max_mb: Annotated[float, Meta(ge=1, le=10_000)] = 64
    max_age_h: Annotated[float, Meta(gt=0, le=720)] = 24
    measurements_hz: Annotated[float, Meta(ge=0.01, le=20)] = 1


class Indicator(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[recording.indicator]`` of ``agent.toml``: a control that shows people in the room that cameras are recorded.

    Attributes:
        device: Room device of this agent, for example a lamp.
        control: Its control, which must not move anything.
        on: Value while cameras are recorded.
        off: Value otherwise.
    """

    device: Id
    control: Id
    on: float = 1.0
    off: float = 0.0


class Recording(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[recording]`` of ``agent.toml``: recordings of sessions on the agent's disk.

    Attributes:
        enabled: Record the sessions of robots.
        max_gb: Maximum size of all recordings [GB]. Uploaded ones are deleted first, then the oldest.
        max_age_days: Recordings are deleted after this time [days].
        min_free_gb: Free space of the disk below which nothing is recorded [GB].
        upload: Upload recordings to the cloud.
        camera_rate_hz: Maximum rate of recorded frames of each camera [Hz]. Cameras are recorded only with the owner's
            consent.
        indicator: Shows people in the room that cameras are recorded; if it fails, they are not recorded.
    """

    enabled: bool = True
    max_gb: Annotated[float, Meta(gt=0, le=100_000)] = 20
    max_age_days: Annotated[float, Meta(gt=0, le=3650)] = 30
    min_free_gb: Annotated[float, Meta(ge=0, le=100_000)] = 1
    upload: bool = True
    camera_rate_hz: Annotated[float, Meta(ge=0.1, le=30)] = 10
    indicator: Indicator | None = None


class AgentConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The content of ``agent.toml``.

    Attributes:
        server: URL of the server.
        name: Display name of the agent.
        devices: The agent's devices.
        ca: File name of the pinned certificate authority; empty to use the authorities of the operating system.
        transport: One of ``device_agent.transports.factory.names()``.
        http: Polling of the ``http`` transport.
        allow_unconfined_scripts: Run movement scripts even if this machine cannot confine them. Only set by hand.
        buffer: Disk buffer.
        recording: Recordings of sessions.
        room: Streams of the space that movement scripts may read.
    """

    server: str
    name: Label
    devices: tuple[DeviceEntry, ...]
    ca: str = ""
    transport: str = "mqtt"
    http: HttpPolling = HttpPolling()
    allow_unconfined_scripts: bool = False
    buffer: Buffer = Buffer()
    recording: Recording = Recording()
    room: Annotated[tuple[RoomStream, ...], Meta(max_length=64)] = ()

    @property
    def transport_name(self) -> str:
        """Name of the transport in latency reports: plain polling has a name of its own."""
        return "http-poll" if self.transport == "http" and self.http.poll == "plain" else self.transport

    @classmethod
    def load(cls, folder: Path) -> "AgentConfig":
        """Read and check ``agent.toml`` in the agent's folder.

        Raises:
            ConfigError: The file is missing or invalid; the message names the field.
        """
        path = folder / CONFIG_FILE
        try:
            config = msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), cls)
        except FileNotFoundError as error:
            raise ConfigError(f"{path} is missing; run `python -m device_agent enroll` first") from error
        except (OSError, tomllib.TOMLDecodeError, msgspec.ValidationError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: {error}") from error
        _check(config, path)
        return config

    def save(self, folder: Path) -> None:
        """Write ``agent.toml``.

        Raises:
            ConfigError: The file cannot be written.
        """
        lines = [f"{key} = {_toml(getattr(self, key))}" for key in ("server", "name", "transport")]
        if self.ca:
            lines.insert(1, f"ca = {_toml(self.ca)}")
        if self.allow_unconfined_scripts:
            lines.append("allow_unconfined_scripts = true")
        if self.transport == "http" or self.http != HttpPolling():
            lines += ["", "[http]", *_table(self.http)]
        if self.buffer != Buffer():
            lines += ["", "[buffer]", *_table(self.buffer)]
        if self.recording != Recording():
            lines += ["", "[recording]", *_table(self.recording)]
        for stream in self.room:
            lines += ["", "[[room]]", *_table(stream)]
        for device in self.devices:
            lines += ["", *device.lines()]
        private_file.write(folder / CONFIG_FILE, ("\n".join(lines) + "\n").encode())

    def with_manual_settings(self, previous: "AgentConfig") -> "AgentConfig":
        """This configuration with the settings of ``previous`` that ``enroll`` has no option for."""
        interlocks = {device.name: device.interlocks for device in previous.devices}
        devices = [replace(device, interlocks=interlocks.get(device.name, ())) for device in self.devices]
        names = {device.name for device in devices}
        devices += [device for device in previous.devices if device.described and device.name not in names]
        return replace(
            self,
            devices=tuple(devices),
            room=previous.room,
            buffer=previous.buffer,
            recording=previous.recording,
            allow_unconfined_scripts=previous.allow_unconfined_scripts,
        )

    @property
    def room_sources(self) -> tuple[tuple[str, str], ...]:
        """Device and stream of each room measurement that the agent subscribes to, without duplicates."""
        sources = [(stream.device, stream.stream) for stream in self.room]
        sources += [(rule.device, rule.stream) for device in self.devices for rule in device.interlocks]
        return tuple(dict.fromkeys(sources))


def _check(config: AgentConfig, path: Path) -> None:
    names = [device.name for device in config.devices]
    if not names or _has_duplicates(names):
        raise ConfigError(f"{path}: needs at least one device, each with a unique name")
    for source, _ in config.room_sources:
        if source not in names and "-" not in source:
            raise ConfigError(
                f"{path}: '{source}' is not a device of this agent ({', '.join(names)}); "
                "name a device of another agent by its id, as the console shows it"
            )
    for device in config.devices:
        if _has_duplicates([rule.name for rule in device.interlocks]):
            raise ConfigError(f"{path}: two interlocks of '{device.name}' have the same device, stream and condition")
        _check_description(device, path)


def _check_description(device: DeviceEntry, path: Path) -> None:
    """Check the fields that describe a room device."""
    if not device.described:
        if device.diagnostics or device.watch:
            raise ConfigError(f"{path}: '{device.name}' has no `streams` or `cameras` for `diagnostics` and `watch`")
        return
    if device.room:
        raise ConfigError(
            f"{path}: the room '{device.room}' describes '{device.name}'; remove `room`, or the description here"
        )
    if not device.driver:
        raise ConfigError(f"{path}: '{device.name}' needs `driver`; `python -m device_agent devices` lists the drivers")
    try:
        rooms.check_device(device.room_device())
    except ProtocolError as error:
        raise ConfigError(f"{path}: {error}") from error


def _has_duplicates(names: Sequence[str]) -> bool:
    return len(set(names)) != len(names)


def _table(entry: Struct) -> list[str]:
    return [f"{key} = {_toml(value)}" for key, value in msgspec.to_builtins(entry).items() if value is not None]


def _toml(value: Any) -> str:
    """A TOML value. Equals JSON, except for tables, U+007F and characters that JSON escapes as two surrogates."""
    if isinstance(value, dict):
        entries = ((key, each) for key, each in value.items() if each is not None)  # TOML has no null
        return "{" + ", ".join(f"{_toml(key)} = {_toml(each)}" for key, each in entries) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
