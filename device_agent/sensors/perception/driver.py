"""Room driver that fuses the agent's lidars and cameras in its own thread."""

import logging
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn

import msgspec
import numpy as np
from msgspec import Struct, field

from device_agent.perception import grid_image
from device_agent.perception.background_model import BackgroundModel, BackgroundModelError
from device_agent.perception.grid_rows import occupancy_rows
from device_agent.perception.object_classes import Mount, ObjectClass, ObjectPosition
from device_agent.perception.occupancy_grid import OccupancyGrid
from device_agent.perception.sensor_fusion import SensorFusion, Zone
from device_agent.perception.tracker import Box
from device_agent.ports.sensor import Capture, Image, RoomDriver, Scan, SensorError, Values
from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import room as rooms
from device_agent.protocol.manifests.room import Room, RoomDeviceManifest
from device_agent.sensors import png

log = logging.getLogger(__name__)

POSITIONS, PRESENCE, LIGHT, OCCUPANCY = "positions", "presence", "light", "occupancy"
STREAMS = (POSITIONS, PRESENCE, LIGHT, OCCUPANCY)
MAP, SURVEY = "map", "survey"
CAPTURES = (OCCUPANCY, MAP, SURVEY)
SURVEY_SAMPLES, SURVEY_EVERY_S = 20, 0.5
"""Number of samples of a survey and their interval; people who walk through are filtered out."""
COLOURS_EVERY_S = 1.0
"""Interval of colour images, which only provide brightness [s]."""
OLDEST_S = 30.0
"""Objects not detected for this time are not reported [s]."""
SILENT_S = 3.0
"""The driver fails when it has had no sensor data for this time [s]."""
_EDGE_M = 0.2
"""The grid extends into the walls by this distance [m]."""
_STOP_TIMEOUT_S = 5.0
_RESPONSE_S = 10.0
_DIGITS = 3


class _ClassOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An ``ObjectClass`` without the start position, which the room's manifest defines."""

    name: str
    lowest_m: float
    highest_m: float
    radius_m: float
    fastest_m_s: float = 1.5
    several: bool = False

    def __post_init__(self) -> None:
        self.at(None)  # validates the fields

    def at(self, start_m: tuple[float, float] | None) -> ObjectClass:
        """The object class with a start position."""
        return ObjectClass(**msgspec.structs.asdict(self), start_m=start_m)


class _MountOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A ``Mount`` without the position, which the room's manifest defines."""

    name: str
    lowest_m: float
    highest_m: float
    radius_m: float
    reach_m: float


class Options(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the manifest.

    Attributes:
        lidars: Names of the (level) lidars to use.
        cameras: Names of the depth and colour cameras to use.
        light: Name of the room's light meter; empty for none.
        survey: File with the background model of the empty room, in the room's folder. It is read at start-up.
        kinds: Object classes that may enter the room.
        mounts: The room's robots with a fixed base.
        quiet: Boxes (lowest x, y, highest x, y [m]) in which no new tracks start.
        look_hz: Sampling rate of the sensors; ``seldom_hz``: lower rates for single sensors.
        resolution_m: Cell size of the grid [m].
    """

    lidars: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    light: str = ""
    survey: str = ""
    kinds: tuple[_ClassOptions, ...] = ()
    mounts: tuple[_MountOptions, ...] = ()
    quiet: tuple[Box, ...] = ()
    look_hz: float = 6.0
    seldom_hz: dict[str, float] = field(default_factory=dict)
    resolution_m: float = 0.05

    def __post_init__(self) -> None:
        if not all(0 < rate_hz <= 50 for rate_hz in (self.look_hz, *self.seldom_hz.values())):  # noqa: PLR2004 - as for streams
            raise ValueError("look_hz and seldom_hz must be above 0 and at most 50")
        sensors = (*self.lidars, *self.cameras)
        for name in self.seldom_hz:
            if name not in sensors:
                raise ValueError(f"seldom_hz names '{name}', which is not one of its sensors: {', '.join(sensors)}")
        if not 0.01 <= self.resolution_m <= 1:  # noqa: PLR2004 - cells of a useful size
            raise ValueError("resolution_m must be between 0.01 and 1")


class PerceptionDriver:
    """A ``RoomDriver`` that reads the agent's other room drivers.

    Streams:
        positions: ``x_m.{name}``, ``y_m.{name}``, ``age_s.{name}``, ``speed_m_s.{name}``, and ``yaw_rad.{name}``
            after the first motion.
        presence: ``people``, ``people.{zone}``, ``present.{zone}``.
        light: ``light_lux``, ``brightness.{zone}``.
        occupancy: The floor by rows, see ``perception.grid_rows``.

    Captures: ``occupancy`` (an image), ``map`` (the grid as JSON), and ``survey``: a new file for the option
    ``survey``. Clear the room before taking it.
    """

    def __init__(self, device: RoomDeviceManifest, folder: Path, neighbours: Mapping[str, RoomDriver]) -> None:
        self._device = device
        self._folder = folder
        self._neighbours = neighbours
        try:
            self._options = msgspec.convert(device.options, Options)
        except msgspec.ValidationError as error:
            known = ", ".join(Options.__struct_fields__)
            raise SensorError(f"options of '{device.name}': {error}; valid options: {known}") from error
        self._fusion: SensorFusion | None = None
        self._thread: SupervisedThread | None = None
        self._stopping = threading.Event()
        self._life = threading.Lock()
        self._share = 1.0
        self._sampled_s = -np.inf
        self._next_s: dict[str, float] = {}
        self._sensor_errors: dict[str, str] = {}

    # ------------------------------------------------------------ RoomDriver

    @property
    def simulated(self) -> bool:
        """Whether one of the sensors is simulated."""
        return any(self._neighbours[name].simulated for name in self._sensors if name in self._neighbours)

    def connect(self) -> None:
        """See ``RoomDriver``."""
        with self._life:
            if self._thread is not None:
                return
            for name in filter(None, (*self._sensors, self._options.light)):
                if name not in self._neighbours:
                    known = ", ".join(sorted(self._neighbours)) or "none"
                    raise SensorError(f"'{self._device.name}' needs device '{name}'; this agent's devices: {known}")
            fusion = self._fusion = self._fusion or self.make()
            self._sampled_s = time.monotonic()
            self._stopping.clear()
            self._thread = thread = SupervisedThread(
                lambda: self._run(thread, fusion),
                name="perception",
                part="perception",
                device=self._device.name,
                stopping=self._stopping,
                recovery=Recovery.RESTART,
                within_s=_RESPONSE_S,
            )
            thread.start()

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``."""
        fusion = self._require()
        now_s = time.monotonic()
        if stream == POSITIONS:
            return _flat(fusion.positions(now_s))
        if stream == PRESENCE:
            return fusion.presence(now_s)
        if stream == LIGHT:
            return {**self._light(), **{name: round(value, _DIGITS) for name, value in fusion.brightness().items()}}
        if stream == OCCUPANCY:
            return occupancy_rows(fusion.grid)
        return self._reject_unknown("stream", stream, STREAMS)

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        fusion = self._require()
        now_s = time.monotonic()
        if name == OCCUPANCY:
            return Capture("image/png", png.encode(grid_image.draw(fusion.grid, fusion.positions(now_s))))
        if name == MAP:
            return Capture("application/json", msgspec.json.encode(_map(fusion.grid, fusion.positions(now_s))))
        if name == SURVEY:
            return Capture("application/octet-stream", self._take_survey().to_bytes())
        return self._reject_unknown("capture", name, CAPTURES)

    def set(self, control: str, value: float) -> float:  # noqa: ARG002 (it has none)
        """See ``RoomDriver``."""
        return self._reject_unknown("control", control, ())

    def raw(self) -> Scan | Image | None:
        """See ``RoomDriver``."""
        return None

    def close(self) -> None:
        """See ``RoomDriver``."""
        with self._life:
            if self._thread is not None:
                self._stopping.set()
                self._thread.join(timeout=_STOP_TIMEOUT_S)
                self._thread = None

    def reduce(self, share: float) -> None:
        """See ``Reducible``."""
        self._share = share

    # ------------------------------------------------------------ for path planning

    @property
    def grid(self) -> OccupancyGrid:
        """The occupancy grid; the same object during the driver's lifetime.

        Raises:
            SensorError: Not connected yet.
        """
        return self._require().grid

    def make(self) -> SensorFusion:
        """A new ``SensorFusion`` with this driver's configuration.

        Raises:
            SensorError: The room's manifest or background model cannot be used.
        """
        try:
            room = rooms.load(self._folder)
        except ProtocolError as error:
            raise SensorError(str(error)) from error
        (low_x, low_y), (high_x, high_y) = room.plan.lower_m, room.plan.upper_m
        return SensorFusion(
            grid=OccupancyGrid(
                (low_x - _EDGE_M, low_y - _EDGE_M),
                (high_x + _EDGE_M, high_y + _EDGE_M),
                self._options.resolution_m,
                plan=(low_x, low_y, high_x, high_y),
            ),
            background=self._background(),
            kinds=self._kinds(room),
            mounts=self._mounts(room),
            zones=[Zone(zone.name, (*zone.lower_m[:2], *zone.upper_m[:2])) for zone in room.zones],
            quiet=self._options.quiet,
            inside=(low_x, low_y, high_x, high_y),
        )

    # ------------------------------------------------------------ internal

    @property
    def _sensors(self) -> tuple[str, ...]:
        return (*self._options.lidars, *self._options.cameras)

    def _require(self) -> SensorFusion:
        fusion = self._fusion
        if fusion is None or self._thread is None:
            raise SensorError(f"'{self._device.name}' is not connected")
        if time.monotonic() - self._sampled_s > SILENT_S:
            reason = "; ".join(sorted(self._sensor_errors.values())) or "its sensors return no data"
            raise SensorError(f"'{self._device.name}' has no sensor data: {reason}")
        return fusion

    def _kinds(self, room: Room) -> list[ObjectClass]:
        """The object classes; robots start where the manifest places them."""
        result = []
        for kind in self._options.kinds:
            robot = room.robot(kind.name)
            result.append(kind.at(None if robot is None else (robot.position_m[0], robot.position_m[1])))
        return result

    def _mounts(self, room: Room) -> list[Mount]:
        result = []
        for mount in self._options.mounts:
            robot = room.robot(mount.name)
            if robot is None:
                known = ", ".join(robot.name for robot in room.robots) or "none"
                raise SensorError(f"mounts of '{self._device.name}': no robot '{mount.name}'; the room has: {known}")
            result.append(Mount(**msgspec.structs.asdict(mount), near_m=(robot.position_m[0], robot.position_m[1])))
        return result

    def _background(self) -> BackgroundModel:
        if not self._options.survey:
            return BackgroundModel()
        path = self._folder / self._options.survey
        try:
            return BackgroundModel.from_bytes(path.read_bytes())
        except (OSError, BackgroundModelError) as error:
            raise SensorError(
                f"{path}: {error}; clear the room, capture '{SURVEY}' of '{self._device.name}', and store it there"
            ) from error

    def _take_survey(self) -> BackgroundModel:
        result = BackgroundModel()
        for _ in range(SURVEY_SAMPLES):
            for name in self._sensors:
                raw = self._neighbours[name].raw()
                if isinstance(raw, Scan) or (isinstance(raw, Image) and raw.depth_m is not None):
                    result.add(name, raw)
            if self._stopping.wait(SURVEY_EVERY_S):
                raise SensorError(f"'{self._device.name}' was closed before the survey was done")
        try:
            result.fit()
        except BackgroundModelError as error:
            raise SensorError(str(error)) from error
        return result

    def _light(self) -> dict[str, float]:
        if not self._options.light:
            return {}
        read = self._neighbours[self._options.light].read("light")
        return {name: float(value) for name, value in read.items() if name == "light_lux"}

    @property
    def _period_s(self) -> float:
        """Present time between two samples [s]."""
        return 1.0 / (self._options.look_hz * self._share)

    def _run(self, thread: SupervisedThread, fusion: SensorFusion) -> None:
        due_s = time.monotonic()
        while not self._stopping.is_set():
            thread.beat()
            for name in self._sensors:
                self._sample(fusion, name)
            now_s = time.monotonic()
            fusion.advance(now_s)
            # Skip missed periods: the next sample is complete.
            due_s = max(due_s + self._period_s, now_s)
            self._stopping.wait(due_s - now_s)

    def _sample(self, fusion: SensorFusion, name: str) -> None:
        now_s = time.monotonic()
        if now_s < self._next_s.get(name, -np.inf):
            return
        if name in self._options.seldom_hz:
            self._next_s[name] = now_s + 1.0 / self._options.seldom_hz[name]
        try:
            raw = self._neighbours[name].raw()
            if raw is None:
                raise SensorError(f"'{name}' provides neither scans nor images")  # noqa: TRY301 (handled like a silent sensor)
            fusion.update(name, raw)
        except SensorError as error:
            if name not in self._sensor_errors:
                log.warning("perception: %s", error)
            self._sensor_errors[name] = str(error)
        except Exception as error:  # the thread must survive every error of a sensor
            if name not in self._sensor_errors:
                log.exception("perception")
            self._sensor_errors[name] = f"'{name}': {error}"
        else:
            self._sensor_errors.pop(name, None)
            self._sampled_s = time.monotonic()
            if isinstance(raw, Image) and raw.depth_m is None:
                self._next_s[name] = self._sampled_s + COLOURS_EVERY_S

    def _reject_unknown(self, label: str, name: str, known: tuple[str, ...]) -> NoReturn:
        available = ", ".join(known) or "none"
        raise SensorError(f"'{self._device.name}' has no {label} '{name[:80]}'; it has: {available}")


def _flat(positions: Mapping[str, ObjectPosition]) -> dict[str, float]:
    """Positions as measurements."""
    result = {}
    for name, position in sorted(positions.items()):
        if position.age_s > OLDEST_S:
            continue
        result[f"x_m.{name}"] = round(position.x_m, _DIGITS)
        result[f"y_m.{name}"] = round(position.y_m, _DIGITS)
        result[f"age_s.{name}"] = round(position.age_s, _DIGITS)
        result[f"speed_m_s.{name}"] = round(position.speed_m_s, _DIGITS)
        if position.yaw_rad is not None:
            result[f"yaw_rad.{name}"] = round(position.yaw_rad, _DIGITS)
    return result


def _map(grid: OccupancyGrid, positions: Mapping[str, ObjectPosition]) -> dict[str, object]:
    """The grid as JSON: rows from the lowest y, occupancy of each cell in per cent, 50 if unknown."""
    return {
        "lower_m": grid.lower_m,
        "resolution_m": grid.resolution_m,
        "shape": grid.shape,
        "taken_percent": np.rint(grid.probability() * 100).astype(int).tolist(),
        "places": _flat(positions),
    }
