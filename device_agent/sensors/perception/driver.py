"""Looks at the room with the agent's lidars and cameras, several times a second, in a thread of its own."""

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
from device_agent.perception.background_model import BackgroundModel, SurveyError
from device_agent.perception.grid_rows import rows
from device_agent.perception.object_classes import Mount, ObjectClass, Place
from device_agent.perception.occupancy_grid import OccupancyGrid
from device_agent.perception.sensor_fusion import SensorFusion, Zone
from device_agent.perception.tracker import Box
from device_agent.ports.sensor import Capture, Image, RoomDriver, Scan, SensorError, Values
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import room as rooms
from device_agent.protocol.manifests.room import Room, RoomDeviceManifest
from device_agent.sensors import png

log = logging.getLogger(__name__)

POSITIONS, PRESENCE, LIGHT, OCCUPANCY = "positions", "presence", "light", "occupancy"
STREAMS = (POSITIONS, PRESENCE, LIGHT, OCCUPANCY)
MAP, SURVEY = "map", "survey"
CAPTURES = (OCCUPANCY, MAP, SURVEY)
SURVEY_LOOKS, SURVEY_EVERY_S = 20, 0.5
"""How long a survey takes: people who walk through it disappear."""
COLOURS_EVERY_S = 1.0
"""How often it looks at colours: they tell how bright it is, and no more [s]."""
OLDEST_S = 30.0
"""Whom no sensor has seen for that long is not told of any more [s]."""
SILENT_S = 3.0
"""After that long without a look it says that it sees nothing [s]."""
_EDGE_M = 0.2
"""The grid reaches that far into the walls [m]."""
_STOP_TIMEOUT_S = 5.0
_DIGITS = 3


class _Kind(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A ``ObjectClass`` without the place where it begins, which is the robot's in the room's manifest."""

    name: str
    lowest_m: float
    highest_m: float
    radius_m: float
    fastest_m_s: float = 1.5
    several: bool = False

    def __post_init__(self) -> None:
        self.begins(None)  # which says what is wrong

    def begins(self, start_m: tuple[float, float] | None) -> ObjectClass:
        """It, where it begins."""
        return ObjectClass(**msgspec.structs.asdict(self), start_m=start_m)


class _Mount(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A ``Mount`` without the place, which is the robot's in the room's manifest."""

    name: str
    lowest_m: float
    highest_m: float
    radius_m: float
    reach_m: float


class Options(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the manifest says.

    Attributes:
        lidars: Names of the devices to look with; level ones.
        cameras: The same of depth and colour cameras.
        light: Name of the room's light meter; empty for none.
        survey: File of the empty room, in the room's folder. It is read at the start, where it is there.
        kinds: Who may come into the room.
        mounts: Which of the room's robots are fixed to something.
        quiet: Boxes (lowest x, y, highest x, y [m]) in which nobody appears from nothing.
        look_hz: How often it looks; ``seldom_hz``: the same of single lidars and cameras, where less will do.
        resolution_m: Side of a cell of the grid [m].
    """

    lidars: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    light: str = ""
    survey: str = ""
    kinds: tuple[_Kind, ...] = ()
    mounts: tuple[_Mount, ...] = ()
    quiet: tuple[Box, ...] = ()
    look_hz: float = 6.0
    seldom_hz: dict[str, float] = field(default_factory=dict)
    resolution_m: float = 0.05

    def __post_init__(self) -> None:
        if not all(0 < rate_hz <= 50 for rate_hz in (self.look_hz, *self.seldom_hz.values())):  # noqa: PLR2004 - as for streams
            raise ValueError("look_hz and seldom_hz are above 0, and 50 at most")
        eyes = (*self.lidars, *self.cameras)
        for name in self.seldom_hz:
            if name not in eyes:
                raise ValueError(
                    f"seldom_hz names '{name}', with which it does not look; it does with: {', '.join(eyes)}"
                )
        if not 0.01 <= self.resolution_m <= 1:  # noqa: PLR2004 - cells of a useful size
            raise ValueError("resolution_m lies between 0.01 and 1")


class PerceptionDriver:
    """A ``RoomDriver`` (see ``ports.sensor``) over the others of its agent.

    Streams ``positions`` (``x_m.{who}``, ``y_m.{who}``, ``age_s.{who}``, ``speed_m_s.{who}``, and ``yaw_rad.{who}``
    once it has gone somewhere), ``presence`` (``people``, ``people.{zone}``, ``present.{zone}``), ``light``
    (``light_lux``, ``brightness.{zone}``), ``occupancy`` (the floor, row by row: see ``perception.rows``); captures
    ``occupancy`` (a picture), ``map`` (the grid as numbers, JSON), and ``survey``: the room as it is now, for the
    option of that name. Clear the room before.
    """

    def __init__(self, device: RoomDeviceManifest, folder: Path, neighbours: Mapping[str, RoomDriver]) -> None:
        self._device = device
        self._folder = folder
        self._neighbours = neighbours
        try:
            self._options = msgspec.convert(device.options, Options)
        except msgspec.ValidationError as error:
            known = ", ".join(Options.__struct_fields__)
            raise SensorError(f"options of '{device.name}': {error}; there are: {known}") from error
        self._sight: SensorFusion | None = None
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._life = threading.Lock()
        self._looked_s = -np.inf
        self._next_s: dict[str, float] = {}
        self._blind: dict[str, str] = {}

    # ------------------------------------------------------------ RoomDriver

    @property
    def simulated(self) -> bool:
        """See ``RoomDriver``: as what it looks with."""
        return any(self._neighbours[name].simulated for name in self._eyes if name in self._neighbours)

    def connect(self) -> None:
        """See ``RoomDriver``."""
        with self._life:
            if self._thread is not None:
                return
            for name in filter(None, (*self._eyes, self._options.light)):
                if name not in self._neighbours:
                    known = ", ".join(sorted(self._neighbours)) or "none"
                    raise SensorError(f"'{self._device.name}' is to look with '{name}'; this agent's devices: {known}")
            self._sight = self._sight or self.make()
            self._looked_s = time.monotonic()
            self._stopping.clear()
            self._thread = threading.Thread(target=self._run, args=(self._sight,), name="perception", daemon=True)
            self._thread.start()

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``."""
        sight = self._require()
        now_s = time.monotonic()
        if stream == POSITIONS:
            return _flat(sight.places(now_s))
        if stream == PRESENCE:
            return sight.presence(now_s)
        if stream == LIGHT:
            return {**self._light(), **{name: round(value, _DIGITS) for name, value in sight.brightness().items()}}
        if stream == OCCUPANCY:
            return rows(sight.grid)
        return self._lacks("stream", stream, STREAMS)

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        sight = self._require()
        now_s = time.monotonic()
        if name == OCCUPANCY:
            return Capture("image/png", png.encode(grid_image.draw(sight.grid, sight.places(now_s))))
        if name == MAP:
            return Capture("application/json", msgspec.json.encode(_map(sight.grid, sight.places(now_s))))
        if name == SURVEY:
            return Capture("application/octet-stream", self._take_survey().content())
        return self._lacks("capture", name, CAPTURES)

    def set(self, control: str, value: float) -> float:  # noqa: ARG002 (it has none)
        """See ``RoomDriver``."""
        return self._lacks("control", control, ())

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

    # ------------------------------------------------------------ for who plans ways

    @property
    def grid(self) -> OccupancyGrid:
        """Which places are taken. The same one as long as the driver lives.

        Raises:
            SensorError: Not connected yet.
        """
        return self._require().grid

    def make(self) -> SensorFusion:
        """What it will look with, before anything is seen: for its own thread, and for who drives time by hand.

        Raises:
            SensorError: The room's manifest or survey cannot be used.
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
            survey=self._survey(),
            kinds=self._kinds(room),
            mounts=self._mounts(room),
            zones=[Zone(zone.name, (*zone.lower_m[:2], *zone.upper_m[:2])) for zone in room.zones],
            quiet=self._options.quiet,
            inside=(low_x, low_y, high_x, high_y),
        )

    # ------------------------------------------------------------ inside

    @property
    def _eyes(self) -> tuple[str, ...]:
        return (*self._options.lidars, *self._options.cameras)

    def _require(self) -> SensorFusion:
        sight = self._sight
        if sight is None or self._thread is None:
            raise SensorError(f"'{self._device.name}' is not connected")
        if time.monotonic() - self._looked_s > SILENT_S:
            why = "; ".join(sorted(self._blind.values())) or "its sensors say nothing"
            raise SensorError(f"'{self._device.name}' sees nothing: {why}")
        return sight

    def _kinds(self, room: Room) -> list[ObjectClass]:
        """Robots that move begin where the manifest puts them."""
        found = []
        for kind in self._options.kinds:
            robot = room.robot(kind.name)
            found.append(kind.begins(None if robot is None else (robot.position_m[0], robot.position_m[1])))
        return found

    def _mounts(self, room: Room) -> list[Mount]:
        found = []
        for mount in self._options.mounts:
            robot = room.robot(mount.name)
            if robot is None:
                known = ", ".join(one.name for one in room.robots) or "none"
                raise SensorError(f"mounts of '{self._device.name}': no robot '{mount.name}'; the room has: {known}")
            found.append(Mount(**msgspec.structs.asdict(mount), near_m=(robot.position_m[0], robot.position_m[1])))
        return found

    def _survey(self) -> BackgroundModel:
        if not self._options.survey:
            return BackgroundModel()
        path = self._folder / self._options.survey
        try:
            return BackgroundModel.read(path.read_bytes())
        except (OSError, SurveyError) as error:
            raise SensorError(
                f"{path}: {error}; clear the room, capture '{SURVEY}' of '{self._device.name}', and put it there"
            ) from error

    def _take_survey(self) -> BackgroundModel:
        found = BackgroundModel()
        for _ in range(SURVEY_LOOKS):
            for name in self._eyes:
                raw = self._neighbours[name].raw()
                if isinstance(raw, Scan) or (isinstance(raw, Image) and raw.depth_m is not None):
                    found.look(name, raw)
            if self._stopping.wait(SURVEY_EVERY_S):
                raise SensorError(f"'{self._device.name}' was closed before the survey was done")
        try:
            found.settle()
        except SurveyError as error:
            raise SensorError(str(error)) from error
        return found

    def _light(self) -> dict[str, float]:
        if not self._options.light:
            return {}
        read = self._neighbours[self._options.light].read("light")
        return {name: float(value) for name, value in read.items() if name == "light_lux"}

    def _run(self, sight: SensorFusion) -> None:
        period_s = 1.0 / self._options.look_hz
        due_s = time.monotonic()
        while not self._stopping.is_set():
            for name in self._eyes:
                self._look(sight, name)
            now_s = time.monotonic()
            sight.settle(now_s)
            # What was missed is not made up for: the next look sees all there is to see.
            due_s = max(due_s + period_s, now_s)
            self._stopping.wait(due_s - now_s)

    def _look(self, sight: SensorFusion, name: str) -> None:
        now_s = time.monotonic()
        if now_s < self._next_s.get(name, -np.inf):
            return
        if name in self._options.seldom_hz:
            self._next_s[name] = now_s + 1.0 / self._options.seldom_hz[name]
        try:
            raw = self._neighbours[name].raw()
            if raw is None:
                raise SensorError(f"'{name}' takes neither scans nor pictures")  # noqa: TRY301 (as when it is silent)
            sight.see(name, raw)
        except SensorError as error:
            if name not in self._blind:
                log.warning("perception: %s", error)
            self._blind[name] = str(error)
        except Exception as error:  # nothing may end this thread: who asks would be told of what is long gone
            if name not in self._blind:
                log.exception("perception")
            self._blind[name] = f"'{name}': {error}"
        else:
            self._blind.pop(name, None)
            self._looked_s = time.monotonic()
            if isinstance(raw, Image) and raw.depth_m is None:
                self._next_s[name] = self._looked_s + COLOURS_EVERY_S

    def _lacks(self, what: str, name: str, known: tuple[str, ...]) -> NoReturn:
        there = ", ".join(known) or "none"
        raise SensorError(f"'{self._device.name}' has no {what} '{name[:80]}'; it has: {there}")


def _flat(places: Mapping[str, Place]) -> dict[str, float]:
    """Places as measurements carry them."""
    found = {}
    for name, place in sorted(places.items()):
        if place.age_s > OLDEST_S:
            continue
        found[f"x_m.{name}"] = round(place.x_m, _DIGITS)
        found[f"y_m.{name}"] = round(place.y_m, _DIGITS)
        found[f"age_s.{name}"] = round(place.age_s, _DIGITS)
        found[f"speed_m_s.{name}"] = round(place.speed_m_s, _DIGITS)
        if place.yaw_rad is not None:
            found[f"yaw_rad.{name}"] = round(place.yaw_rad, _DIGITS)
    return found


def _map(grid: OccupancyGrid, places: Mapping[str, Place]) -> dict[str, object]:
    """The grid for programs: rows from the lowest y, each cell in per cent, 50 where nothing is known."""
    return {
        "lower_m": grid.lower_m,
        "resolution_m": grid.resolution_m,
        "shape": grid.shape,
        "taken_percent": np.rint(grid.probability() * 100).astype(int).tolist(),
        "places": _flat(places),
    }
