"""Where robots stand that are fixed to something: what never moves of them is their base."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from device_agent.perception.object_classes import Mount, Place

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

CELL_M = 0.05
BASE_M = 0.4
"""The base is looked for this far from where the robot was said to stand [m]: further away are its arms, and others."""
MEMORY_S = 30.0
"""Time constant of what counts as never moving [s]."""
DOUBT = 4.0
"""So many times slower it learns from looks that show something, but not its base: a hand before it is none."""
MOSTLY = 0.5
"""A place belongs to the base when it is taken at least this share of the time of the one that is taken most."""
OFTEN = 0.2
"""Share of the time that the place taken most must reach: less is somebody who passed, or a flaw."""
MET = 0.5
"""Share of the base's places that must be taken for it to be seen."""
FEWEST_CELLS = 3
FEWEST_LOOKS = 10


@dataclass(slots=True)
class _Side:
    """What one camera sees of it, in cells round where it was said to stand.

    Attributes:
        from_m: Where the camera is, shape (2,) [m].
        share: Of the time that each cell was taken, while any was.
    """

    from_m: Floats
    share: Floats
    _age_s: float = 0.0
    _looks: int = 0
    _at_s: float = -math.inf

    def learn(self, now: Bools, at_s: float) -> bool:
        """Take in which cells are taken; whether its base is among them."""
        elapsed_s = min(1.0, max(0.05, at_s - self._at_s))
        self._at_s = at_s
        if np.count_nonzero(now) < FEWEST_CELLS:
            return False  # hidden: nothing to learn
        base = self.base
        met = bool(base.any()) and int(np.count_nonzero(now & base)) >= MET * int(np.count_nonzero(base))
        self._age_s += elapsed_s
        memory_s = min(MEMORY_S, self._age_s) * (DOUBT if base.any() and not met else 1.0)
        self._looks += 1
        self.share += min(1.0, elapsed_s / memory_s) * (now - self.share)
        return met

    @property
    def base(self) -> Bools:
        """Which cells are its base; none before enough was seen."""
        most = float(self.share.max())
        known = self._looks >= FEWEST_LOOKS and most >= OFTEN
        found: Bools = self.share >= MOSTLY * most if known else np.zeros(self.share.shape, dtype=bool)
        return found


@dataclass(slots=True)
class FixedRobots:
    """One such robot. Not thread-safe.

    Attributes:
        mount: What is known of it.
    """

    mount: Mount
    _sides: dict[str, _Side] = field(default_factory=dict, init=False)
    _seen_s: float = field(default=-math.inf, init=False)

    def own(self, points_m: Floats) -> Bools:
        """Which points are near enough, and high enough, to be of it, shape (n,)."""
        away = np.hypot(points_m[:, 0] - self.mount.near_m[0], points_m[:, 1] - self.mount.near_m[1])
        found: Bools = (away < self.mount.reach_m) & (points_m[:, 2] > self.mount.lowest_m)
        return found

    def see(self, sensor: str, points_m: Floats, from_m: Floats, at_s: float) -> None:
        """Take in one look: its points, shape (n, 3) [m], the camera's x, y, shape (2,), and when [s]."""
        half = math.ceil(BASE_M / CELL_M)
        if sensor not in self._sides:
            self._sides[sensor] = _Side(from_m, np.zeros((2 * half, 2 * half)))
        low = points_m[points_m[:, 2] < self.mount.highest_m]
        cells = np.floor((low[:, :2] - self.mount.near_m) / CELL_M).astype(np.int64) + half
        cells = cells[((cells >= 0) & (cells < 2 * half)).all(axis=1)]
        now = np.zeros((2 * half, 2 * half), dtype=bool)
        now[cells[:, 0], cells[:, 1]] = True
        if self._sides[sensor].learn(now, at_s):
            self._seen_s = max(self._seen_s, at_s)

    def place(self, now_s: float) -> Place | None:
        """Where its base is, and how long ago that was seen; ``None`` before it was."""
        found = [(self._middle(side), np.count_nonzero(side.base)) for side in self._sides.values() if side.base.any()]
        if not found or not math.isfinite(self._seen_s):
            return None
        weight = np.array([cells for _, cells in found], dtype=np.float64)
        x_m, y_m = (weight @ np.stack([middle for middle, _ in found]) / weight.sum()).tolist()
        return Place(x_m, y_m, max(0.0, now_s - self._seen_s))

    def _middle(self, side: _Side) -> Floats:
        """Of the base, shape (2,) [m]: behind what one camera sees of it."""
        cells = np.argwhere(side.base)
        weight = side.share[cells[:, 0], cells[:, 1]]
        seen = (weight @ cells / weight.sum() - side.share.shape[0] // 2 + 0.5) * CELL_M + self.mount.near_m
        way = seen - side.from_m
        found: Floats = seen + way / max(float(np.hypot(*way)), 1e-6) * self.mount.radius_m
        return found
