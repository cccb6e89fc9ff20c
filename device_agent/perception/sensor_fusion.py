"""Fuses lidars and cameras into an occupancy grid, tracks and presence."""

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from device_agent.perception import projection
from device_agent.perception.background_model import BackgroundModel
from device_agent.perception.fixed_robots import FixedRobot
from device_agent.perception.object_classes import Mount, ObjectClass, ObjectPosition
from device_agent.perception.occupancy_grid import OccupancyGrid
from device_agent.perception.tracker import Box, Track, Tracker
from device_agent.ports.sensor import Image, Scan

Floats = NDArray[np.float64]

FLOOR_M = 0.05
"""Lower points are floor; the error of depth cameras [m]."""
OBSTACLE_M = (0.1, 1.9)
"""Heights of obstacles for people and robots [m]."""
ERROR_1_M = 0.004
"""Distant obstacles must be higher by this times the squared distance: twice the depth error [1/m]."""
MAPPED_M = 5.5
"""Points at a greater distance have errors above a cell and are not mapped [m]."""
GRID_EVERY_S = 0.3
"""Interval at which depth images update the grid [s]."""
PRESENT_S = 2.0
"""Tracks without detection for this time do not count as present [s]."""
BELOW_M, BESIDE_M, LEGS_M = 0.1, 0.1, 0.25
"""Points this far below a robot's base and this near beside it belong to another object [m]."""
BELOW_HEAD_M = 0.3
"""Points higher than every object class by this are ignored [m]."""
ZONE_STEP_M = 0.2
LUMINANCE = np.array([0.2126, 0.7152, 0.0722]) / 255
"""Weights of red, green, blue (ITU-R BT.709)."""


@dataclass(frozen=True, slots=True)
class Zone:
    """A named part of the floor, ``box_m``: lowest x and y, highest x and y [m]."""

    name: str
    box_m: Box

    def holds(self, x_m: float, y_m: float) -> bool:
        """Whether a point is inside."""
        low_x, low_y, high_x, high_y = self.box_m
        return low_x <= x_m <= high_x and low_y <= y_m <= high_y

    def floor_m(self) -> Floats:
        """A grid of floor points, shape (n, 3) [m]."""
        low_x, low_y, high_x, high_y = self.box_m
        across, up = np.meshgrid(
            np.arange(low_x + ZONE_STEP_M / 2, high_x, ZONE_STEP_M),
            np.arange(low_y + ZONE_STEP_M / 2, high_y, ZONE_STEP_M),
        )
        return np.column_stack((across.ravel(), up.ravel(), np.zeros(across.size)))


@dataclass(slots=True, kw_only=True)
class SensorFusion:
    """State of the room. Thread-safe; one thread calls ``update``, any number read.

    Attributes:
        grid: The occupancy grid.
        background: The empty room.
        kinds: Object classes that may enter; ``mounts``: robots with a fixed base.
        zones: Parts of the floor to monitor.
        quiet: Boxes in which no new tracks start, for example at a door.
        inside: Box within the walls, in which objects are tracked.
    """

    grid: OccupancyGrid
    background: BackgroundModel
    kinds: Sequence[ObjectClass]
    mounts: Sequence[Mount] = ()
    zones: Sequence[Zone] = ()
    quiet: Sequence[Box] = ()
    inside: Box = (-math.inf, -math.inf, math.inf, math.inf)
    _tracks: Tracker = field(init=False)
    _mounted: tuple[FixedRobot, ...] = field(init=False)
    _lenses: dict[str, projection.Lens] = field(default_factory=dict, init=False)
    _brightness: dict[str, dict[str, float]] = field(default_factory=dict, init=False)
    _advanced_s: float | None = field(default=None, init=False)
    _mapped_s: dict[str, float] = field(default_factory=dict, init=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False)

    def __post_init__(self) -> None:
        self._tracks = Tracker(self.kinds, self.quiet)
        self._mounted = tuple(map(FixedRobot, self.mounts))

    # ------------------------------------------------------------ input

    def update(self, sensor: str, raw: Scan | Image) -> None:
        """Add a scan or image. Samples may arrive out of order."""
        if isinstance(raw, Scan):
            self._add_scan(sensor, raw)
            return
        if raw.depth_m is not None:
            self._add_depth(sensor, raw)
        if raw.rgb is not None:
            self._add_colours(sensor, raw)

    def advance(self, now_s: float) -> None:
        """Advance time [s]; call it several times per second."""
        if self._advanced_s is not None and now_s > self._advanced_s:
            self.grid.advance(now_s - self._advanced_s)
        self._advanced_s = now_s

    def _add_scan(self, sensor: str, scan: Scan) -> None:
        ends, met = projection.ends(scan)
        self.grid.add_rays(sensor, (float(scan.position_m[0]), float(scan.position_m[1])), ends, met)
        foreground = self.background.foreground(sensor, scan)
        if foreground is not None:
            with self._lock:
                self._tracks.update("lidar", self._within(ends[met & foreground]), scan.position_m[:2], scan.taken_s)

    def _add_depth(self, sensor: str, image: Image) -> None:
        depth_m = projection.depths(image)
        assert image.depth_m is not None  # noqa: S101 - for the type checker
        height, width = image.depth_m.shape
        lines = self._lenses.setdefault(sensor, projection.Lens()).lines(height, width, image.fovy_rad)
        if image.taken_s - self._mapped_s.get(sensor, -math.inf) >= GRID_EVERY_S:
            self._mapped_s[sensor] = image.taken_s
            within = np.isfinite(depth_m)
            self._map(sensor, projection.points(image, depth_m[within], lines[within]), np.asarray(image.position_m))
        foreground = self.background.foreground(sensor, image)
        if foreground is not None:
            points_m = projection.points(image, depth_m[foreground], lines[foreground])
            points_m = self._within(points_m[(points_m[:, 2] > FLOOR_M) & (points_m[:, 2] < self._max_height_m)])
            with self._lock:
                self._share(sensor, points_m, np.asarray(image.position_m[:2], dtype=np.float64), image.taken_s)

    def _within(self, points_m: Floats) -> Floats:
        low_x, low_y, high_x, high_y = self.inside
        x, y = points_m[:, 0], points_m[:, 1]
        result: Floats = points_m[(x > low_x) & (x < high_x) & (y > low_y) & (y < high_y)]
        return result

    @property
    def _max_height_m(self) -> float:
        heights = [kind.highest_m for kind in self.kinds] + [mount.highest_m for mount in self.mounts]
        return max(heights, default=2.0) + BELOW_HEAD_M

    def _map(self, sensor: str, points_m: Floats, from_m: Floats) -> None:
        """Update the grid: visible floor is free unless something is above it."""
        away = np.linalg.norm(points_m - from_m, axis=1)
        above = (points_m[:, 2] > OBSTACLE_M[0] + ERROR_1_M * away**2) & (points_m[:, 2] < OBSTACLE_M[1])
        counted = (above | (np.abs(points_m[:, 2]) < FLOOR_M)) & (away < MAPPED_M)
        self.grid.add_points(sensor, points_m[counted, :2], above[counted])

    def _share(self, sensor: str, points_m: Floats, from_m: Floats, at_s: float) -> None:
        """Assign points to fixed robots, except those of people in front of them; track the rest."""
        free = np.ones(len(points_m), dtype=bool)
        for mounted in self._mounted:
            own = free & mounted.mask(points_m)
            own[own] = ~_on_legs(points_m[own], points_m[points_m[:, 2] < mounted.mount.lowest_m - BELOW_M])
            mounted.update(sensor, points_m[own], from_m, at_s)
            free &= ~own
        self._tracks.update("depth", points_m[free], from_m, at_s)

    def _add_colours(self, sensor: str, image: Image) -> None:
        assert image.rgb is not None  # noqa: S101 - for the type checker
        height, width = image.rgb.shape[:2]
        result = {}
        for zone in self.zones:
            positions = projection.pixels(image, zone.floor_m(), height, width)
            if len(positions):
                result[zone.name] = float((image.rgb[positions[:, 0], positions[:, 1]] @ LUMINANCE).mean())
        with self._lock:
            self._brightness[sensor] = result

    # ------------------------------------------------------------ output

    def positions(self, now_s: float) -> dict[str, ObjectPosition]:
        """Positions of all objects by name."""
        with self._lock:
            result = self._tracks.positions(now_s)
            for mounted in self._mounted:
                position = mounted.position(now_s)
                if position is not None and position.finite:
                    result[mounted.mount.name] = position
        return result

    def presence(self, now_s: float) -> Mapping[str, float | bool]:
        """``people``, ``people.{zone}`` and ``present.{zone}`` (people and moving robots)."""
        with self._lock:
            present = [
                (_person(track), *track.ahead(now_s).tolist())
                for track in self._tracks.all
                if track.confirmed and now_s - track.seen_s < PRESENT_S
            ]
        result: dict[str, float | bool] = {"people": float(sum(person for person, _, _ in present))}
        for zone in self.zones:
            inside = [person for person, x_m, y_m in present if zone.holds(x_m, y_m)]
            result[f"people.{zone.name}"] = float(sum(inside))
            result[f"present.{zone.name}"] = bool(inside)
        return result

    def brightness(self) -> Mapping[str, float]:
        """Brightness of each zone's floor in the camera images, 0…1: ``brightness.{zone}``."""
        with self._lock:
            by_sensor = list(self._brightness.values())
        result = {}
        for zone in self.zones:
            values = [brightness[zone.name] for brightness in by_sensor if zone.name in brightness]
            if values:
                result[f"brightness.{zone.name}"] = sum(values) / len(values)
        return result


def _on_legs(points_m: Floats, low_m: Floats) -> NDArray[np.bool_]:
    """Mask of points with lower points below them, shape (n,): objects that stand on the floor."""
    if not len(low_m) or not len(points_m):
        return np.zeros(len(points_m), dtype=bool)
    cells = np.unique(np.floor(low_m[:, :2] / BESIDE_M), axis=0)
    middles = (cells + 0.5) * BESIDE_M
    away = np.linalg.norm(points_m[:, None, :2] - middles[None], axis=2)
    result: NDArray[np.bool_] = away.min(axis=1) < LEGS_M
    return result


def _person(track: Track) -> bool:
    """Whether a track is a person: a class with several instances."""
    return track.kind is not None and track.kind.several
