"""Manifest of a room, ``robots/rooms/<room>/room.toml``: its robots and devices."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct

from device_agent.protocol import CameraStream, Id, Label, Stream, Text, Vector3, camera_frames, description
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import toml
from device_agent.protocol.manifests.robot_type import Diagnostic, RobotType, check_diagnostics

MANIFEST = "room.toml"
MAX_RATE_HZ = 50.0
"""Maximum rate of a stream [Hz]; the limit of telemetry."""
_PERIOD_MS = 50
"""Period in which a room device checks Stop and holds [ms]."""
_NO_BRAKING_RAD_S2 = 1.0
"""Placeholder: a robot type requires a value, but a room device has no joints."""

Vector2 = tuple[float, float]


class Plan(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Extent of the floor, x and y in the room's frame, and height of the ceiling [m]."""

    lower_m: Vector2
    upper_m: Vector2
    height_m: float


class RoomRobot(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A robot of the room and the pose of its base, z up.

    Attributes:
        name: Device name at the agent, unique in the room.
        type: Robot type.
        label: Display name; empty for the label of the type.
        position_m: Position of the model's origin in the room [m].
        yaw_rad: Rotation about the vertical [rad].
    """

    name: Id
    type: Id
    label: Label = ""
    position_m: Vector3
    yaw_rad: float = 0.0


class Control(description.Control, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Control of a manifest; see ``description.Control``."""


class Watch(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Supervision of a stream or camera: when it is faulty although its driver reports no fault.

    Attributes:
        source: Stream or camera.
        silent_s: Fault after this time without data [s]; ``None``: silence is allowed.
        stuck_s: Fault after this time with exactly equal values [s]; ``None``: equal values are allowed. Only for
            sources with noise: a closed door may report the same value forever, a working thermometer never does.
    """

    source: Id
    silent_s: Annotated[float, Meta(gt=0, le=86_400)] | None = None
    stuck_s: Annotated[float, Meta(gt=0, le=86_400)] | None = None


class RoomDeviceManifest(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A sensor or switch of the room.

    Attributes:
        name: Device name at the agent, unique in the room.
        kind: ``camera``, ``thermometer`` …; also the name of its robot type.
        label: Display name.
        driver: One of ``device_agent.sensors.names()``.
        streams: Measurement streams with their default rates.
        cameras: Streams of frames with their rates and kinds.
        captures: Raw data that can be captured: ``image``, ``scan`` …
        controls: Values that can be set.
        diagnostics: How the cloud evaluates measurements; the first match of a field applies.
        watch: Supervision of streams and cameras.
        position_m: Position in the room [m].
        options: Options of the driver.
    """

    name: Id
    kind: Id
    label: Label
    driver: Id
    streams: Annotated[tuple[Stream, ...], Meta(max_length=16)] = ()
    cameras: Annotated[tuple[CameraStream, ...], Meta(max_length=4)] = ()
    captures: Annotated[tuple[Id, ...], Meta(max_length=16)] = ()
    controls: Annotated[tuple[Control, ...], Meta(max_length=16)] = ()
    diagnostics: Annotated[tuple[Diagnostic, ...], Meta(max_length=32)] = ()
    watch: Annotated[tuple[Watch, ...], Meta(max_length=20)] = ()
    position_m: Vector3 = (0.0, 0.0, 0.0)
    options: dict[str, Any] = {}

    def robot_type(self) -> RobotType:
        """The device as a robot type without joints, so that leases, Stop, actions and interlocks apply to it."""
        abilities = ("streams", "cameras", "captures", "controls")
        return RobotType(
            type=self.kind,
            label=self.label,
            kind=self.kind,
            version=1,
            description="",
            model="",
            scene="",
            driver=self.driver,
            period_ms=_PERIOD_MS,
            joints=(),
            frames=(),
            home_rad={},
            braking_rad_s2=_NO_BRAKING_RAD_S2,
            capabilities=tuple(name for name in abilities if getattr(self, name)),
            streams=self.streams,
            diagnostics=self.diagnostics,
        )


class Zone(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A named box of the room, for presence. ``lower_m``: lowest corner; ``upper_m``: highest corner [m]."""

    name: Id
    label: Label
    lower_m: Vector3
    upper_m: Vector3


class Person(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A simulated pedestrian. Manifests of real rooms have none.

    Attributes:
        name: Body in the room's model.
        path_m: Corners of a closed path [m].
        speed_m_s: Walking speed [m/s].
        pause_s: Pause at each corner [s].
    """

    name: Id
    path_m: Annotated[tuple[Vector2, ...], Meta(min_length=2, max_length=64)]
    speed_m_s: float = 0.8
    pause_s: float = 2.0


class Climate(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of the simulated air and light. Manifests of real rooms have none.

    Attributes:
        ventilation_per_h: Air changes with a closed door [1/h].
        door_m3_h: Air exchange with the corridor through the open door [m³/h].
        loss_w_k: Heat loss through walls and window [W/K].
        capacity_j_k: Heat capacity of the air, and of furniture and walls in the short term [J/K].
        heater_w: Maximum power of the radiator [W].
        outside_c: Outside temperature [°C].
        corridor_c: Temperature of the corridor [°C].
        outside_humidity_percent: Outside relative humidity [%].
        outside_co2_ppm: CO₂ of the outside air [ppm].
        corridor_co2_ppm: CO₂ of the corridor [ppm].
        daylight_lux: Daylight in the middle of the room with open blinds [lx].
        lamp_lux: Light of the lamp at full brightness in the same place [lx].
        quiet_db: Sound level of the empty room, A-weighted [dB].
        start_c: Initial temperature [°C].
        start_humidity_percent: Initial relative humidity [%].
        start_co2_ppm: Initial CO₂ [ppm].
    """

    ventilation_per_h: float = 1.0
    door_m3_h: float = 250.0
    loss_w_k: float = 35.0
    capacity_j_k: float = 600_000.0
    heater_w: float = 1500.0
    outside_c: float = 8.0
    corridor_c: float = 19.0
    outside_humidity_percent: float = 70.0
    outside_co2_ppm: float = 420.0
    corridor_co2_ppm: float = 550.0
    daylight_lux: float = 450.0
    lamp_lux: float = 380.0
    quiet_db: float = 34.0
    start_c: float = 20.5
    start_humidity_percent: float = 42.0
    start_co2_ppm: float = 620.0


class Room(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A room. The origin of its frame is on the floor, z is up.

    Attributes:
        room: Id, equal to the folder's name.
        version: Rises with each change that affects robots or people.
        model: MJCF file of the room without robots, relative to the folder; empty for a real room.
        plan: Extent of the room.
        robots: Robots and their poses.
        devices: Sensors and switches.
        zones: Named boxes.
        people: Simulated pedestrians.
        climate: Simulated air and light.
        start: Initial settings of the simulation: position of an actuator of the model in its joint's unit, ``lamp``
            (0…1) or ``thermostat`` [°C].
    """

    room: Id
    version: int
    label: Label
    description: Text = ""
    model: str = ""
    plan: Plan
    robots: Annotated[tuple[RoomRobot, ...], Meta(max_length=32)] = ()
    devices: Annotated[tuple[RoomDeviceManifest, ...], Meta(max_length=128)] = ()
    zones: Annotated[tuple[Zone, ...], Meta(max_length=32)] = ()
    people: Annotated[tuple[Person, ...], Meta(max_length=8)] = ()
    climate: Climate = Climate()
    start: dict[Id, float] = {}

    def robot(self, name: str) -> RoomRobot | None:
        """The robot of this name, or ``None``."""
        return next((robot for robot in self.robots if robot.name == name), None)

    def device(self, name: str) -> RoomDeviceManifest | None:
        """The device of this name, or ``None``."""
        return next((device for device in self.devices if device.name == name), None)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all robots and devices."""
        return (*(robot.name for robot in self.robots), *(device.name for device in self.devices))


def load(folder: Path) -> Room:
    """Read and check the manifest of a room's folder.

    Raises:
        ProtocolError: The manifest is missing or wrong. The message names file and field.
    """
    return toml.load(folder / MANIFEST, parse, named="room")


def parse(text: str) -> Room:
    """Parse a manifest from TOML text.

    Raises:
        ProtocolError: The text is not TOML, a field is wrong, or fields contradict each other.
    """
    room = toml.convert(text, Room)
    toml.check_box("plan", room.plan.lower_m, room.plan.upper_m)
    toml.check_positive("height_m of the plan", room.plan.height_m)
    _check_names("robots and devices", room.names)
    _check_names("zones", [zone.name for zone in room.zones])
    for robot in room.robots:
        _check_finite(f"robot '{robot.name}'", (*robot.position_m, robot.yaw_rad))
        _check_inside(f"robot '{robot.name}'", robot.position_m, room.plan)
    for device in room.devices:
        check_device(device)
    for zone in room.zones:
        toml.check_box(f"zone '{zone.name}'", zone.lower_m, zone.upper_m)
    for person in room.people:
        _check_person(person, room.plan)
    _check_climate(room.climate)
    _check_finite("start", room.start.values())
    return room


def check_device(device: RoomDeviceManifest) -> None:
    """Check that the fields of a device do not contradict each other.

    Raises:
        ProtocolError: They do; the message names device and field.
    """
    where = f"device '{device.name}'"
    _check_finite(where, device.position_m)
    _check_names(f"streams of {where}", [stream.name for stream in device.streams])
    _check_names(f"cameras of {where}", [camera.name for camera in device.cameras])
    _check_names(f"captures of {where}", device.captures)
    _check_names(f"controls of {where}", [control.name for control in device.controls])
    for stream in (*device.streams, *device.cameras):
        if not 0 < stream.rate_hz <= MAX_RATE_HZ:
            raise ProtocolError(
                f"rate_hz of stream '{stream.name}' of {where} must be above 0 and at most {MAX_RATE_HZ:g}"
            )
    for camera in device.cameras:
        if camera.kind not in camera_frames.KINDS:
            raise ProtocolError(
                f"kind '{camera.kind}' of camera '{camera.name}' of {where} is unknown; use one of: "
                f"{', '.join(camera_frames.KINDS)}"
            )
    for control in device.controls:
        if not -math.inf < control.lower < control.upper < math.inf:
            raise ProtocolError(
                f"control '{control.name}' of {where}: lower must be below upper, and both must be finite"
            )
    _check_supervision(device, where)


def _check_supervision(device: RoomDeviceManifest, where: str) -> None:
    """Reject diagnostics and supervision of unknown streams."""
    try:
        check_diagnostics(device.diagnostics)
    except ProtocolError as error:
        raise ProtocolError(f"{where}: {error}") from error
    streams = [stream.name for stream in device.streams]
    sources = [*streams, *(camera.name for camera in device.cameras)]
    references = [("diagnostics", diagnostic.stream, streams) for diagnostic in device.diagnostics]
    references += [("watch", watch.source, sources) for watch in device.watch]
    for label, name, known in references:
        if name not in known:
            raise ProtocolError(f"{label} of {where}: there is no '{name}'; known: {', '.join(known) or 'none'}")


def _check_person(person: Person, plan: Plan) -> None:
    where = f"person '{person.name}'"
    toml.check_positive(f"speed_m_s of {where}", person.speed_m_s)
    if not 0 <= person.pause_s < math.inf:
        raise ProtocolError(f"pause_s of {where} must be at least 0 and finite")
    for corner in person.path_m:
        _check_finite(where, corner)
        _check_inside(where, corner, plan)
    sides = zip(person.path_m, (*person.path_m[1:], person.path_m[0]), strict=True)
    if any(math.dist(start, end) == 0 for start, end in sides):
        raise ProtocolError(f"path_m of {where} has the same corner twice in a row")


def _check_climate(climate: Climate) -> None:
    _check_finite("climate", [getattr(climate, field) for field in Climate.__struct_fields__])
    toml.check_positive("capacity_j_k of climate", climate.capacity_j_k)
    for field in ("ventilation_per_h", "door_m3_h", "loss_w_k", "heater_w", "daylight_lux", "lamp_lux"):
        if getattr(climate, field) < 0:
            raise ProtocolError(f"{field} of climate must be at least 0")


def _check_inside(where: str, position_m: Sequence[float], plan: Plan) -> None:
    for value, lower, upper in zip(position_m, plan.lower_m, plan.upper_m, strict=False):
        if not lower <= value <= upper:
            raise ProtocolError(f"{where} is outside of the plan: {tuple(position_m[:2])}")


def _check_names(label: str, names: Sequence[str]) -> None:
    duplicates = sorted({name for name in names if list(names).count(name) > 1})
    if duplicates:
        raise ProtocolError(f"{label}: the name '{duplicates[0]}' is used twice")


def _check_finite(where: str, values: Iterable[float]) -> None:
    if not all(map(math.isfinite, values)):
        raise ProtocolError(f"{where}: all numbers must be finite")
