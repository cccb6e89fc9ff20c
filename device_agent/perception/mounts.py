"""Where robots stand that are fixed to something: what never moves of them is their base."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from device_agent.perception.kinds import Mount, Place

Floats = NDArray[np.float64]

CELL_M = 0.05
MEMORY_S = 30.0
"""Time constant of what counts as never moving [s]."""
MOSTLY = 0.5
"""A place belongs to the base when it is taken at least this share of the time of the one that is taken most."""
OFTEN = 0.2
"""Share of the time that the place taken most must reach: less is somebody who passed, or a flaw."""
FEWEST_CELLS = 3
FEWEST_LOOKS = 10


@dataclass(slots=True)
class Mounted:
    """One such robot. Not thread-safe.

    Attributes:
        mount: What is known of it.
    """

    mount: Mount
    _share: Floats = field(init=False)
    _from_m: Floats = field(init=False)
    _age_s: float = field(default=0.0, init=False)
    _looks: int = field(default=0, init=False)
    _at_s: float = field(default=-math.inf, init=False)
    _seen_s: float = field(default=-math.inf, init=False)

    def __post_init__(self) -> None:
        side = 2 * math.ceil(self.mount.reach_m / CELL_M)
        self._share = np.zeros((side, side))
        self._from_m = np.zeros(2)

    def own(self, points_m: Floats) -> NDArray[np.bool_]:
        """Which points are near enough, and high enough, to be of it, shape (n,)."""
        away = np.hypot(points_m[:, 0] - self.mount.near_m[0], points_m[:, 1] - self.mount.near_m[1])
        found: NDArray[np.bool_] = (away < self.mount.reach_m) & (points_m[:, 2] > self.mount.lowest_m)
        return found

    def see(self, points_m: Floats, from_m: Floats, at_s: float) -> None:
        """Take in one look: its points, shape (n, 3) [m], the camera's x, y, shape (2,), and when [s]."""
        elapsed_s = min(1.0, max(0.05, at_s - self._at_s))
        self._at_s = at_s
        base = points_m[points_m[:, 2] < self.mount.highest_m]
        half = self._share.shape[0] // 2
        cells = np.floor((base[:, :2] - self.mount.near_m) / CELL_M).astype(np.int64) + half
        cells = cells[((cells >= 0) & (cells < 2 * half)).all(axis=1)]
        if len(cells) < FEWEST_CELLS:
            return  # hidden: nothing to learn
        now = np.zeros_like(self._share)
        now[cells[:, 0], cells[:, 1]] = 1.0
        self._age_s += elapsed_s
        self._looks += 1
        self._share += min(1.0, elapsed_s / min(MEMORY_S, self._age_s)) * (now - self._share)
        self._from_m, self._seen_s = from_m, at_s

    def place(self, now_s: float) -> Place | None:
        """Where its base is; ``None`` before it was seen."""
        most = float(self._share.max())
        if self._looks < FEWEST_LOOKS or most < OFTEN:
            return None
        cells = np.argwhere(self._share >= MOSTLY * most)
        weight = self._share[cells[:, 0], cells[:, 1]]
        half = self._share.shape[0] // 2
        seen = (weight @ cells / weight.sum() - half + 0.5) * CELL_M + self.mount.near_m
        way = seen - self._from_m
        x_m, y_m = map(float, seen + way / max(float(np.hypot(*way)), 1e-6) * self.mount.radius_m)
        return Place(x_m, y_m, max(0.0, now_s - self._seen_s))
