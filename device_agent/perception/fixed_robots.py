"""Locates robots with a fixed base: the cells that are occupied permanently are the base."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from device_agent.perception.object_classes import Mount, ObjectPosition

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

CELL_M = 0.05
BASE_M = 0.4
"""The base is expected within this distance from its nominal position [m]."""
MEMORY_S = 30.0
"""Time constant of the occupancy estimate [s]."""
OCCLUDED_FACTOR = 4.0
"""Factor by which learning slows down when other points, but not the base, are visible."""
BASE_SHARE = 0.5
"""A cell belongs to the base if occupied at least this share of the most occupied cell's time."""
MIN_OCCUPANCY = 0.2
"""Smallest occupancy of the most occupied cell; less indicates a passing object or noise."""
VISIBLE_SHARE = 0.5
"""Share of the base's cells that must be occupied for the base to count as visible."""
MIN_CELLS = 3
MIN_SAMPLES = 10


@dataclass(slots=True)
class _CameraView:
    """One camera's view of the robot, in cells around the nominal position.

    Attributes:
        from_m: Camera position, shape (2,) [m].
        share: Share of the time that each cell was occupied, while any was.
    """

    from_m: Floats
    share: Floats
    _age_s: float = 0.0
    _samples: int = 0
    _at_s: float = -math.inf

    def learn(self, occupied: Bools, at_s: float) -> bool:
        """Update the occupancy; returns whether the base is visible."""
        elapsed_s = min(1.0, max(0.05, at_s - self._at_s))
        self._at_s = at_s
        if np.count_nonzero(occupied) < MIN_CELLS:
            return False  # occluded
        base = self.base
        visible = bool(base.any()) and int(np.count_nonzero(occupied & base)) >= VISIBLE_SHARE * int(
            np.count_nonzero(base)
        )
        self._age_s += elapsed_s
        memory_s = min(MEMORY_S, self._age_s) * (OCCLUDED_FACTOR if base.any() and not visible else 1.0)
        self._samples += 1
        self.share += min(1.0, elapsed_s / memory_s) * (occupied - self.share)
        return visible

    @property
    def base(self) -> Bools:
        """Mask of the base's cells; empty until there are enough samples."""
        most = float(self.share.max())
        confident = self._samples >= MIN_SAMPLES and most >= MIN_OCCUPANCY
        result: Bools = self.share >= BASE_SHARE * most if confident else np.zeros(self.share.shape, dtype=bool)
        return result


@dataclass(slots=True)
class FixedRobot:
    """One robot with a fixed base. Not thread-safe.

    Attributes:
        mount: Description of the robot's base.
    """

    mount: Mount
    _views: dict[str, _CameraView] = field(default_factory=dict, init=False)
    _seen_s: float = field(default=-math.inf, init=False)

    def mask(self, points_m: Floats) -> Bools:
        """Mask of points that may belong to the robot, shape (n,)."""
        away = np.hypot(points_m[:, 0] - self.mount.near_m[0], points_m[:, 1] - self.mount.near_m[1])
        result: Bools = (away < self.mount.reach_m) & (points_m[:, 2] > self.mount.lowest_m)
        return result

    def update(self, sensor: str, points_m: Floats, from_m: Floats, at_s: float) -> None:
        """Add points, shape (n, 3) [m], seen by a camera at x, y, shape (2,), at a time [s]."""
        half = math.ceil(BASE_M / CELL_M)
        if sensor not in self._views:
            self._views[sensor] = _CameraView(from_m, np.zeros((2 * half, 2 * half)))
        low = points_m[points_m[:, 2] < self.mount.highest_m]
        cells = np.floor((low[:, :2] - self.mount.near_m) / CELL_M).astype(np.int64) + half
        cells = cells[((cells >= 0) & (cells < 2 * half)).all(axis=1)]
        occupied = np.zeros((2 * half, 2 * half), dtype=bool)
        occupied[cells[:, 0], cells[:, 1]] = True
        if self._views[sensor].learn(occupied, at_s):
            self._seen_s = max(self._seen_s, at_s)

    def position(self, now_s: float) -> ObjectPosition | None:
        """Position of the base and its age; ``None`` before it was seen."""
        result = [(self._middle(view), np.count_nonzero(view.base)) for view in self._views.values() if view.base.any()]
        if not result or not math.isfinite(self._seen_s):
            return None
        weight = np.array([cells for _, cells in result], dtype=np.float64)
        x_m, y_m = (weight @ np.stack([middle for middle, _ in result]) / weight.sum()).tolist()
        return ObjectPosition(x_m, y_m, max(0.0, now_s - self._seen_s))

    def _middle(self, view: _CameraView) -> Floats:
        """Centre of the base, shape (2,) [m]: behind the surface that one camera sees."""
        cells = np.argwhere(view.base)
        weight = view.share[cells[:, 0], cells[:, 1]]
        surface = (weight @ cells / weight.sum() - view.share.shape[0] // 2 + 0.5) * CELL_M + self.mount.near_m
        direction = surface - view.from_m
        result: Floats = surface + direction / max(float(np.hypot(*direction)), 1e-6) * self.mount.radius_m
        return result
