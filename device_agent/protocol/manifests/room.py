"""A room's manifest, ``robots/rooms/<room>/room.toml``: the robots that stand in it and the devices that it has."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct

from device_agent.protocol import Id, Label, Stream, Text, Vector3
from device_agent.protocol import description as reports
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import toml
from device_agent.protocol.manifests.robot_type import Diagnostic, RobotType, check_diagnostics

MANIFEST = "room.toml"
MAX_RATE_HZ = 50.0
"""Of a stream, as for telemetry."""
_PERIOD_MS = 50
"""Of a room device: how often it looks whether it is stopped or held."""
_NO_BRAKING_RAD_S2 = 1.0
"""A type must name one; nothing turns here."""

Vector2 = tuple[float, float]


class Plan(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The floor's extent in the room's frame, x and y, and the ceiling's height above it [m]."""

    lower_m: Vector2
    upper_m: Vector2
    height_m: float


class RoomRobot(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One robot of the room: where its base stands, z up.

    Attributes:
        name: Of the device at the agent; unique in the room.
        type: Its robot type.
        label: For people; the type's without it.
        position_m: Of its model's origin in the room [m].
        yaw_rad: About the vertical [rad].
    """

    name: Id
    type: Id
    label: Label = ""
    position_m: Vector3
    yaw_rad: float = 0.0


class Control(reports.Control, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One thing that can be set at a room device, within ``lower`` and ``upper`` [``unit``]."""


class Watch(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a stream or camera of a room device is not well though its driver says nothing of it.

    Attributes:
        source: The stream or camera.
        silent_s: It has given nothing for so long [s]; ``None``: it may be silent.
        stuck_s: What it gave has been exactly the same for so long [s]; ``None``: it may stay the same. Only for what
            has noise: a door that is shut stays so, a thermometer that shows the same hundredths for minutes is broken.
    """

    source: Id
    silent_s: Annotated[float, Meta(gt=0, le=86_400)] | None = None
    stuck_s: Annotated[float, Meta(gt=0, le=86_400)] | None = None


class RoomDeviceManifest(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One sensor or switch of the room.

    Attributes:
        name: Of the device at the agent; unique in the room.
        kind: What it is: ``camera``, ``thermometer`` …; its robot type's name.
        label: For people.
        driver: One of ``device_agent.sensors.names()``.
        streams: What it measures, and how often when nobody asks for another rate.
        cameras: What it films, and how many pictures a second.
        captures: What raw data can be had of it: ``image``, ``scan`` …
        controls: What can be set.
        diagnostics: How what it measures is to be judged; the first that fits a field counts.
        watch: When its streams and cameras are silent or stuck.
        position_m: Where it is in the room [m].
        options: For its driver.
    """

    name: Id
    kind: Id
    label: Label
    driver: Id
    streams: Annotated[tuple[Stream, ...], Meta(max_length=16)] = ()
    cameras: Annotated[tuple[Stream, ...], Meta(max_length=4)] = ()
    captures: Annotated[tuple[Id, ...], Meta(max_length=16)] = ()
    controls: Annotated[tuple[Control, ...], Meta(max_length=16)] = ()
    diagnostics: Annotated[tuple[Diagnostic, ...], Meta(max_length=32)] = ()
    watch: Annotated[tuple[Watch, ...], Meta(max_length=20)] = ()
    position_m: Vector3 = (0.0, 0.0, 0.0)
    options: dict[str, Any] = {}

    def robot_type(self) -> RobotType:
        """It as the type of a device without joints, so that leases, Stop, actions and interlocks hold for it too."""
        does = ("streams", "cameras", "captures", "controls")
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
            capabilities=tuple(name for name in does if getattr(self, name)),
            streams=self.streams,
            diagnostics=self.diagnostics,
        )


class Zone(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A named box of the room, for presence. ``lower_m``: its lowest corner; ``upper_m``: its highest [m]."""

    name: Id
    label: Label
    lower_m: Vector3
    upper_m: Vector3


class Person(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Somebody who walks about in the simulated room. Real rooms name none.

    Attributes:
        name: Of the body in the room's model.
        path_m: The corners of the way, which is walked round and round [m].
        speed_m_s: How fast.
        pause_s: How long each corner is worth standing still.
    """

    name: Id
    path_m: Annotated[tuple[Vector2, ...], Meta(min_length=2, max_length=64)]
    speed_m_s: float = 0.8
    pause_s: float = 2.0


class Climate(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the air of the simulated room depends on. Real rooms name none.

    Attributes:
        ventilation_per_h: Changes of the room's air by fresh air, door shut [1/h].
        door_m3_h: Exchange with the corridor through the wide open door [m³/h].
        loss_w_k: Heat through walls and window, for each kelvin between inside and outside [W/K].
        capacity_j_k: Heat that the room takes for each kelvin: its air, and what furniture and walls take soon [J/K].
        heater_w: Most that the radiator gives [W].
        outside_c: Temperature outside [°C]; ``corridor_c``: behind the door.
        outside_humidity_percent: Relative humidity outside [%].
        outside_co2_ppm: Of the air outside; ``corridor_co2_ppm``: of the corridor's.
        daylight_lux: Inside, in the middle of the room, with the blinds open [lx].
        lamp_lux: Of the lamp at its brightest, in the same place [lx].
        quiet_db: Sound level of the empty room, A-weighted [dB].
        start_c: Temperature when the simulation begins [°C]; ``start_humidity_percent``, ``start_co2_ppm``: the same.
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
    """One room. Its frame has its origin on the floor and z up.

    Attributes:
        room: Its id, the folder's name.
        version: Rises with each change that robots or people could notice.
        model: MJCF file of the room without its robots, relative to the folder; empty for a real room.
        plan: Its extent.
        robots: Who stands where.
        devices: Its sensors and switches.
        zones: Named boxes.
        people: Who walks about in its simulation.
        climate: Its air and light in simulation.
        start: What its simulation is set to in the beginning: the position of an actuator of its model, in its joint's
            own unit, or one of ``lamp`` (0…1) and ``thermostat`` [°C].
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
        """The robot of that name, if there is one."""
        return next((robot for robot in self.robots if robot.name == name), None)

    def device(self, name: str) -> RoomDeviceManifest | None:
        """The device of that name, if there is one."""
        return next((device for device in self.devices if device.name == name), None)

    @property
    def names(self) -> tuple[str, ...]:
        """Of all robots and devices."""
        return (*(robot.name for robot in self.robots), *(device.name for device in self.devices))


def load(folder: Path) -> Room:
    """Read and check the manifest of a room's folder.

    Raises:
        ProtocolError: Missing, not TOML, or a field is wrong; the text names file and field.
    """
    return toml.load(folder / MANIFEST, parse, named="room")


def parse(text: str) -> Room:
    """Read a manifest from TOML text.

    Raises:
        ProtocolError: Not TOML, a field is wrong, or fields contradict each other.
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
        _check_device(device)
    for zone in room.zones:
        toml.check_box(f"zone '{zone.name}'", zone.lower_m, zone.upper_m)
    for person in room.people:
        _check_person(person, room.plan)
    _check_climate(room.climate)
    _check_finite("start", room.start.values())
    return room


def _check_device(device: RoomDeviceManifest) -> None:
    where = f"device '{device.name}'"
    _check_finite(where, device.position_m)
    _check_names(f"streams of {where}", [stream.name for stream in device.streams])
    _check_names(f"cameras of {where}", [camera.name for camera in device.cameras])
    _check_names(f"captures of {where}", device.captures)
    _check_names(f"controls of {where}", [control.name for control in device.controls])
    for stream in (*device.streams, *device.cameras):
        if not 0 < stream.rate_hz <= MAX_RATE_HZ:
            raise ProtocolError(
                f"rate_hz of stream '{stream.name}' of {where} must be above 0, {MAX_RATE_HZ:g} at most"
            )
    for control in device.controls:
        if not -math.inf < control.lower < control.upper < math.inf:
            raise ProtocolError(
                f"control '{control.name}' of {where}: lower must be below upper, and both of them finite"
            )
    _check_judgements(device, where)


def _check_judgements(device: RoomDeviceManifest, where: str) -> None:
    """Refuse diagnostics and watches of what the device has not, or that contradict themselves."""
    try:
        check_diagnostics(device.diagnostics)
    except ProtocolError as error:
        raise ProtocolError(f"{where}: {error}") from error
    streams = [stream.name for stream in device.streams]
    sources = [*streams, *(camera.name for camera in device.cameras)]
    asked = [("diagnostics", each.stream, streams) for each in device.diagnostics]
    asked += [("watch", each.source, sources) for each in device.watch]
    for what, name, known in asked:
        if name not in known:
            raise ProtocolError(f"{what} of {where}: it has no '{name}'; it has: {', '.join(known) or 'none'}")


def _check_person(person: Person, plan: Plan) -> None:
    where = f"person '{person.name}'"
    toml.check_positive(f"speed_m_s of {where}", person.speed_m_s)
    if not 0 <= person.pause_s < math.inf:
        raise ProtocolError(f"pause_s of {where} must be at least 0 and finite")
    for corner in person.path_m:
        _check_finite(where, corner)
        _check_inside(where, corner, plan)
    ends = zip(person.path_m, (*person.path_m[1:], person.path_m[0]), strict=True)
    if any(math.dist(here, there) == 0 for here, there in ends):
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
            raise ProtocolError(f"{where} stands outside of the plan: {tuple(position_m[:2])}")


def _check_names(what: str, names: Sequence[str]) -> None:
    twice = sorted({name for name in names if list(names).count(name) > 1})
    if twice:
        raise ProtocolError(f"{what}: the name '{twice[0]}' is there twice")


def _check_finite(where: str, values: Iterable[float]) -> None:
    if not all(map(math.isfinite, values)):
        raise ProtocolError(f"{where}: all numbers must be finite")
