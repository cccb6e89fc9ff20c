"""What a room knows: puts together what its lidars and cameras see."""

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from device_agent.perception import projection
from device_agent.perception.background_model import BackgroundModel
from device_agent.perception.fixed_robots import FixedRobots
from device_agent.perception.object_classes import Mount, ObjectClass, Place
from device_agent.perception.occupancy_grid import OccupancyGrid
from device_agent.perception.tracker import Box, Track, Tracks
from device_agent.ports.sensor import Image, Scan

Floats = NDArray[np.float64]

FLOOR_M = 0.05
"""What is lower is floor: by that much depth cameras err [m]."""
OBSTACLE_M = (0.1, 1.9)
"""Heights at which something is in the way of people and robots [m]."""
ERROR_1_M = 0.004
"""What is far away must be higher by that times its distance squared: twice what depth cameras err [1/m]."""
MAPPED_M = 5.5
"""What is further away errs by more than a cell, and is left out of the grid [m]."""
GRID_EVERY_S = 0.3
"""The grid learns from depth images that often; its memory is a second [s]."""
PRESENT_S = 2.0
"""Whom nobody has seen for that long is not counted as present [s]."""
BELOW_M, BESIDE_M, LEGS_M = 0.1, 0.1, 0.25
"""Who has something this far below what a robot is fixed to, this near beside, is a visitor [m]."""
BELOW_HEAD_M = 0.3
"""What is higher than anybody by that much is no part of somebody [m]."""
ZONE_STEP_M = 0.2
LUMINANCE = np.array([0.2126, 0.7152, 0.0722]) / 255
"""Weights of red, green, blue (ITU-R BT.709)."""


@dataclass(frozen=True, slots=True)
class Zone:
    """A named part of the floor, ``box_m``: lowest x and y, highest x and y [m]."""

    name: str
    box_m: Box

    def holds(self, x_m: float, y_m: float) -> bool:
        """Whether a place is in it."""
        low_x, low_y, high_x, high_y = self.box_m
        return low_x <= x_m <= high_x and low_y <= y_m <= high_y

    def floor_m(self) -> Floats:
        """Places on its floor, shape (n, 3) [m]."""
        low_x, low_y, high_x, high_y = self.box_m
        across, up = np.meshgrid(
            np.arange(low_x + ZONE_STEP_M / 2, high_x, ZONE_STEP_M),
            np.arange(low_y + ZONE_STEP_M / 2, high_y, ZONE_STEP_M),
        )
        return np.column_stack((across.ravel(), up.ravel(), np.zeros(across.size)))


@dataclass(slots=True, kw_only=True)
class SensorFusion:
    """The room's knowledge. Thread-safe; one thread calls ``see``, any number ask.

    Attributes:
        grid: Which places are taken.
        survey: The empty room.
        kinds: Who may come; ``mounts``: who is fixed to something.
        zones: Parts of the floor to watch.
        quiet: Where nobody appears from nothing: where a door turns.
        inside: Where somebody can be: within the walls.
    """

    grid: OccupancyGrid
    survey: BackgroundModel
    kinds: Sequence[ObjectClass]
    mounts: Sequence[Mount] = ()
    zones: Sequence[Zone] = ()
    quiet: Sequence[Box] = ()
    inside: Box = (-math.inf, -math.inf, math.inf, math.inf)
    _tracks: Tracks = field(init=False)
    _mounted: tuple[FixedRobots, ...] = field(init=False)
    _lenses: dict[str, projection.Lens] = field(default_factory=dict, init=False)
    _brightness: dict[str, dict[str, float]] = field(default_factory=dict, init=False)
    _settled_s: float | None = field(default=None, init=False)
    _mapped_s: dict[str, float] = field(default_factory=dict, init=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False)

    def __post_init__(self) -> None:
        self._tracks = Tracks(self.kinds, self.quiet)
        self._mounted = tuple(map(FixedRobots, self.mounts))

    # ------------------------------------------------------------ what sensors saw

    def see(self, sensor: str, raw: Scan | Image) -> None:
        """Take in what a sensor saw. Older looks than the newest before are as good as new ones."""
        if isinstance(raw, Scan):
            self._see_scan(sensor, raw)
            return
        if raw.depth_m is not None:
            self._see_depth(sensor, raw)
        if raw.rgb is not None:
            self._see_colours(sensor, raw)

    def settle(self, now_s: float) -> None:
        """Let time pass [s]; call it several times a second."""
        if self._settled_s is not None and now_s > self._settled_s:
            self.grid.settle(now_s - self._settled_s)
        self._settled_s = now_s

    def _see_scan(self, sensor: str, scan: Scan) -> None:
        ends, met = projection.ends(scan)
        self.grid.see_rays(sensor, (float(scan.position_m[0]), float(scan.position_m[1])), ends, met)
        new = self.survey.nearer(sensor, scan)
        if new is not None:
            with self._lock:
                self._tracks.see("lidar", self._within(ends[met & new]), scan.position_m[:2], scan.taken_s)

    def _see_depth(self, sensor: str, image: Image) -> None:
        depth_m = projection.depths(image)
        assert image.depth_m is not None  # noqa: S101 - for the type checker; `see` looked
        height, width = image.depth_m.shape
        lines = self._lenses.setdefault(sensor, projection.Lens()).lines(height, width, image.fovy_rad)
        if image.taken_s - self._mapped_s.get(sensor, -math.inf) >= GRID_EVERY_S:
            self._mapped_s[sensor] = image.taken_s
            within = np.isfinite(depth_m)
            self._map(sensor, projection.points(image, depth_m[within], lines[within]), np.asarray(image.position_m))
        new = self.survey.nearer(sensor, image)
        if new is not None:
            seen = projection.points(image, depth_m[new], lines[new])
            seen = self._within(seen[(seen[:, 2] > FLOOR_M) & (seen[:, 2] < self._tallest_m)])
            with self._lock:
                self._share(sensor, seen, np.asarray(image.position_m[:2], dtype=np.float64), image.taken_s)

    def _within(self, points_m: Floats) -> Floats:
        low_x, low_y, high_x, high_y = self.inside
        x, y = points_m[:, 0], points_m[:, 1]
        found: Floats = points_m[(x > low_x) & (x < high_x) & (y > low_y) & (y < high_y)]
        return found

    @property
    def _tallest_m(self) -> float:
        heights = [kind.highest_m for kind in self.kinds] + [mount.highest_m for mount in self.mounts]
        return max(heights, default=2.0) + BELOW_HEAD_M

    def _map(self, sensor: str, seen_m: Floats, from_m: Floats) -> None:
        """Floor that is seen is free, but for what is above it."""
        away = np.linalg.norm(seen_m - from_m, axis=1)
        above = (seen_m[:, 2] > OBSTACLE_M[0] + ERROR_1_M * away**2) & (seen_m[:, 2] < OBSTACLE_M[1])
        counted = (above | (np.abs(seen_m[:, 2]) < FLOOR_M)) & (away < MAPPED_M)
        self.grid.see_points(sensor, seen_m[counted, :2], above[counted])

    def _share(self, sensor: str, seen_m: Floats, from_m: Floats, at_s: float) -> None:
        """Points of robots that are fixed somewhere are theirs, unless they are of somebody who came there."""
        free = np.ones(len(seen_m), dtype=bool)
        for mounted in self._mounted:
            own = free & mounted.own(seen_m)
            own[own] = ~_on_legs(seen_m[own], seen_m[seen_m[:, 2] < mounted.mount.lowest_m - BELOW_M])
            mounted.see(sensor, seen_m[own], from_m, at_s)
            free &= ~own
        self._tracks.see("depth", seen_m[free], from_m, at_s)

    def _see_colours(self, sensor: str, image: Image) -> None:
        assert image.rgb is not None  # noqa: S101 - for the type checker; `see` looked
        height, width = image.rgb.shape[:2]
        found = {}
        for zone in self.zones:
            places = projection.pixels(image, zone.floor_m(), height, width)
            if len(places):
                found[zone.name] = float((image.rgb[places[:, 0], places[:, 1]] @ LUMINANCE).mean())
        with self._lock:
            self._brightness[sensor] = found

    # ------------------------------------------------------------ what is known

    def places(self, now_s: float) -> dict[str, Place]:
        """Where everybody is, by name."""
        with self._lock:
            found = self._tracks.places(now_s)
            for mounted in self._mounted:
                place = mounted.place(now_s)
                if place is not None and place.finite:
                    found[mounted.mount.name] = place
        return found

    def presence(self, now_s: float) -> Mapping[str, float | bool]:
        """Who is in each zone: ``people.{zone}``, ``present.{zone}`` (people and moving robots), and ``people``."""
        with self._lock:
            here = [
                (_person(one), *one.ahead(now_s).tolist())
                for one in self._tracks.all
                if one.confirmed and now_s - one.seen_s < PRESENT_S
            ]
        found: dict[str, float | bool] = {"people": float(sum(person for person, _, _ in here))}
        for zone in self.zones:
            inside = [person for person, x_m, y_m in here if zone.holds(x_m, y_m)]
            found[f"people.{zone.name}"] = float(sum(inside))
            found[f"present.{zone.name}"] = bool(inside)
        return found

    def brightness(self) -> Mapping[str, float]:
        """How bright the floor of each zone looks to the cameras that see it, 0…1: ``brightness.{zone}``."""
        with self._lock:
            seen = list(self._brightness.values())
        found = {}
        for zone in self.zones:
            values = [one[zone.name] for one in seen if zone.name in one]
            if values:
                found[f"brightness.{zone.name}"] = sum(values) / len(values)
        return found


def _on_legs(points_m: Floats, low_m: Floats) -> NDArray[np.bool_]:
    """Which points have others, lower ones, below them, shape (n,): who stands on the floor is not on the table."""
    if not len(low_m) or not len(points_m):
        return np.zeros(len(points_m), dtype=bool)
    cells = np.unique(np.floor(low_m[:, :2] / BESIDE_M), axis=0)
    middles = (cells + 0.5) * BESIDE_M
    away = np.linalg.norm(points_m[:, None, :2] - middles[None], axis=2)
    found: NDArray[np.bool_] = away.min(axis=1) < LEGS_M
    return found


def _person(track: Track) -> bool:
    """Whether somebody is a person: of whom there may be several."""
    return track.kind is not None and track.kind.several
