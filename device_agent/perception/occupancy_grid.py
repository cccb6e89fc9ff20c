"""Which places on the floor are taken: an occupancy grid of the room, from lidar scans and depth images.

Each sensor has layers of its own, because they see different heights: a lidar looks through under a table whose top a
camera sees. A place is taken when one of them says so.

Each layer has two memories of log odds. The *recent* one follows each look within a second. The *lasting* one follows
the recent one within a minute, and is what an unseen place falls back to: so somebody who has left, or went where no
sensor looks, disappears, and a wall behind somebody stays.
"""

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Circle = tuple[float, float, float]
"""x, y, radius in the room [m]."""

RESOLUTION_M = 0.05
TAKEN, CLEAR = 0.9, -0.6
"""Log odds that one look adds: a hit tells more than a ray that passes, as thin things are often missed."""
MOST = 4.0
"""Bound of the log odds: 0.98 sure. More would have to be unlearned when things change."""
OVER = 3.0
"""What a point above the floor counts where others are on it: three of those."""
FADE_S = 2.0
"""Time constant in which what is not looked at falls back to the lasting memory [s]."""
LASTING_S = 60.0
"""Time constant of the lasting memory [s]; in the first minute it is the mean of what has been seen,"""
YOUNG_S = 10.0
"""but never of less than this [s]: who stands about when it begins is no furniture."""
HIDDEN_S = 120.0
"""Time constant in which it forgets what is not looked at [s]: where people are seen and the floor behind them is not,
they would else be all that was ever seen."""
SURE = 0.4
"""Log odds from which on a place counts as taken, or below whose negative as free."""
STATIC = 1.0
"""Log odds of the lasting memory from which on a thing belongs to the room."""


@dataclass(slots=True)
class _Layer:
    """What one sensor says, arrays of shape (rows, columns)."""

    recent: Floats
    lasting: Floats
    seen: Bools
    age_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Floor:
    """Where the middle of something round must not be. Immutable.

    Row 0 is at the lowest y, column 0 at the lowest x of the room.

    Attributes:
        blocked: Shape (rows, columns).
        lower_m: x, y of the grid's lowest corner in the room [m].
        resolution_m: Side of a cell [m].
    """

    blocked: Bools
    lower_m: tuple[float, float]
    resolution_m: float

    def cell(self, x_m: float, y_m: float) -> tuple[int, int]:
        """Row and column of a place in the room; may lie outside of the grid."""
        column = math.floor((x_m - self.lower_m[0]) / self.resolution_m)
        row = math.floor((y_m - self.lower_m[1]) / self.resolution_m)
        return row, column

    def centre(self, row: int, column: int) -> tuple[float, float]:
        """x, y of the middle of a cell in the room [m]."""
        return (
            self.lower_m[0] + (column + 0.5) * self.resolution_m,
            self.lower_m[1] + (row + 0.5) * self.resolution_m,
        )

    def at(self, x_m: float, y_m: float) -> bool:
        """Whether a place is blocked. What lies outside of the grid is."""
        row, column = self.cell(x_m, y_m)
        rows, columns = self.blocked.shape
        return not (0 <= row < rows and 0 <= column < columns) or bool(self.blocked[row, column])


@dataclass(slots=True)
class OccupancyGrid:
    """The room's floor in cells. Thread-safe: one thread looks, any number read.

    To plan a way for a robot of radius 0.25 m that stands at (x, y), and is itself seen by the sensors::

        floor = grid.blocked(0.25, apart=[(x, y, 0.35)])
        floor.at(1.0, 2.0)

    Attributes:
        lower_m: Lowest corner x, y in the room [m].
        upper_m: Highest corner [m].
        resolution_m: Side of a cell [m].
        plan: Lowest x, y and highest x, y between the walls, where that is known [m]: nobody plans a way beyond.
    """

    lower_m: tuple[float, float]
    upper_m: tuple[float, float]
    resolution_m: float = RESOLUTION_M
    plan: tuple[float, float, float, float] | None = None
    _layers: dict[str, _Layer] = field(default_factory=dict, init=False, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.resolution_m <= 0 or any(high <= low for low, high in zip(self.lower_m, self.upper_m, strict=True)):
            raise ValueError("a grid has a resolution above 0, and an upper corner above its lower one")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows (along y) and columns (along x)."""
        across, up = (
            math.ceil((high - low) / self.resolution_m - 1e-9)
            for low, high in zip(self.lower_m, self.upper_m, strict=True)
        )
        return up, across

    # ------------------------------------------------------------ what sensors saw

    def see_rays(self, sensor: str, origin_m: Sequence[float], ends_m: Floats, hit: Bools) -> None:
        """Take in rays parallel to the floor, as a lidar's.

        Args:
            sensor: Whose layer it is.
            origin_m: x, y where they start [m].
            ends_m: Where they end, shape (n, 2) [m].
            hit: Whether something is there, shape (n,); else the ray only went that far.
        """
        origin = np.asarray(origin_m[:2], dtype=np.float64)
        ways = ends_m - origin
        length = np.hypot(ways[:, 0], ways[:, 1])
        if not length.size:
            return
        # The last cell before a hit is left alone: the wall may fill a part of it.
        clear = length - np.where(hit, self.resolution_m, 0.0)
        steps = np.arange(0.0, float(length.max()) + 1e-9, self.resolution_m)
        ray, step = np.nonzero(steps[None, :] < clear[:, None])
        places = origin + (ways / np.maximum(length, 1e-9)[:, None])[ray] * steps[step, None]
        self.see_places(sensor, taken_m=ends_m[hit], clear_m=places)

    def see_points(self, sensor: str, points_m: Floats, taken: Bools) -> None:
        """Take in points: a cell is taken when a quarter of its points say so.

        Who looks in below a desk sees floor there, and the desk's top above it.

        Args:
            sensor: Whose layer it is.
            points_m: Shape (n, 2) [m]; what lies outside of the grid is let go.
            taken: Whether something is there, shape (n,); else the floor was seen.
        """
        cells, inside = self._cells(points_m)
        size = self.shape[0] * self.shape[1]
        votes = np.bincount(cells, np.where(taken[inside], OVER, -1.0), size)
        seen = np.bincount(cells, minlength=size) > 0
        self._learn(sensor, (seen & (votes > 0)).reshape(self.shape), (seen & (votes <= 0)).reshape(self.shape))

    def see_places(self, sensor: str, *, taken_m: Floats, clear_m: Floats) -> None:
        """Take in places that are taken, or free. A cell with both is taken.

        Args:
            sensor: Whose layer it is.
            taken_m: Shape (n, 2) [m]; what lies outside of the grid is let go.
            clear_m: Shape (m, 2) [m].
        """
        taken, clear = self._mask(taken_m), self._mask(clear_m)
        self._learn(sensor, taken, clear & ~taken)

    def _learn(self, sensor: str, taken: Bools, clear: Bools) -> None:
        with self._lock:
            layer = self._layer(sensor)
            layer.recent[taken] = np.minimum(layer.recent[taken] + TAKEN, MOST)
            layer.recent[clear] = np.maximum(layer.recent[clear] + CLEAR, -MOST)
            layer.seen |= taken | clear

    def settle(self, elapsed_s: float) -> None:
        """Let time pass: the lasting memory learns what was seen since, the recent one forgets what was not."""
        with self._lock:
            for layer in self._layers.values():
                layer.age_s += elapsed_s
                learn = min(1.0, elapsed_s / min(LASTING_S, max(YOUNG_S, layer.age_s)))
                layer.lasting[layer.seen] += learn * (layer.recent - layer.lasting)[layer.seen]
                unseen = ~layer.seen
                layer.lasting[unseen] *= math.exp(-elapsed_s / HIDDEN_S)
                # What was there only for a while is not there for sure any more, nor is nothing.
                usual = np.where(np.abs(layer.lasting) > STATIC, layer.lasting, np.minimum(layer.lasting, 0.0))
                keep = math.exp(-elapsed_s / FADE_S)
                layer.recent[unseen] = (usual + keep * (layer.recent - usual))[unseen]
                layer.seen[:] = False

    # ------------------------------------------------------------ what is known

    def probability(self) -> Floats:
        """How sure it is that something is there now, shape (rows, columns), 0…1; 0.5 where nothing is known."""
        recent, _ = self._known()
        found: Floats = 1.0 / (1.0 + np.exp(-recent))
        return found

    def taken(self) -> Bools:
        """Where something is now, shape (rows, columns)."""
        return self._known()[0] > SURE

    def static(self) -> Bools:
        """Where something has been for long and is now: walls, furniture, shape (rows, columns).

        Their edges are in it, where a look hits them or not.
        """
        recent, lasting = self._known()
        taken = recent > SURE
        return taken & _spread(taken & (lasting > STATIC), 1.0)

    def moving(self) -> Bools:
        """Where something is now that was not there before, shape (rows, columns)."""
        return self.taken() & ~self.static()

    def blocked(self, radius_m: float, *, apart: Sequence[Circle] = (), unknown: bool = True) -> Floor:
        """Where the middle of something round with this radius would touch what is there.

        Args:
            radius_m: Of whoever wants to go there, with the room it wants to keep [m].
            apart: Places where what is there does not count: the robot itself, whom sensors see as well.
            unknown: Whether what nobody has seen is blocked too. Gaps of one cell beside free ones are not.
        """
        recent, _ = self._known()
        taken, free = recent > SURE, recent < -SURE
        for x_m, y_m, apart_m in apart:
            circle = self._circle(x_m, y_m, apart_m)
            taken &= ~circle
            free |= circle
        taken |= self._walls()
        blocked = _spread(taken, radius_m / self.resolution_m)
        if unknown:
            blocked |= ~(taken | _spread(free, 1.0))
        blocked.setflags(write=False)
        return Floor(blocked, self.lower_m, self.resolution_m)

    # ------------------------------------------------------------ inside

    def _layer(self, sensor: str) -> _Layer:
        if sensor not in self._layers:
            self._layers[sensor] = _Layer(np.zeros(self.shape), np.zeros(self.shape), np.zeros(self.shape, dtype=bool))
        return self._layers[sensor]

    def _known(self) -> tuple[Floats, Floats]:
        """Recent and lasting log odds over all sensors, shape (rows, columns)."""
        with self._lock:
            if not self._layers:
                return np.zeros(self.shape), np.zeros(self.shape)
            recent = _together([layer.recent for layer in self._layers.values()])
            return recent, _together([layer.lasting for layer in self._layers.values()])

    def _mask(self, places_m: Floats) -> Bools:
        mask = np.zeros(self.shape, dtype=bool)
        mask.ravel()[self._cells(places_m)[0]] = True
        return mask

    def _cells(self, places_m: Floats) -> tuple[NDArray[np.int64], Bools]:
        """Flat index of the cells of places, and which places lie in the grid, shape (n,).

        What is no number does not.
        """
        rows, columns = self.shape
        across, up = ((places_m - self.lower_m) / self.resolution_m).T
        inside: Bools = (across >= 0) & (across < columns) & (up >= 0) & (up < rows)
        return up[inside].astype(np.int64) * columns + across[inside].astype(np.int64), inside

    def _walls(self) -> Bools:
        """What lies outside of the plan, shape (rows, columns)."""
        walls = np.zeros(self.shape, dtype=bool)
        if self.plan is not None:
            across, up = self._middles()
            low_x, low_y, high_x, high_y = self.plan
            walls |= ((across < low_x) | (across > high_x))[None, :] | ((up < low_y) | (up > high_y))[:, None]
        return walls

    def _middles(self) -> tuple[Floats, Floats]:
        """Middle of each column along x, and of each row along y [m]."""
        rows, columns = self.shape
        across: Floats = self.lower_m[0] + (np.arange(columns, dtype=np.float64) + 0.5) * self.resolution_m
        up: Floats = self.lower_m[1] + (np.arange(rows, dtype=np.float64) + 0.5) * self.resolution_m
        return across, up

    def _circle(self, x_m: float, y_m: float, radius_m: float) -> Bools:
        across, up = self._middles()
        across, up = across - x_m, up - y_m
        found: Bools = up[:, None] ** 2 + across[None, :] ** 2 <= radius_m**2
        return found


def _together(layers: list[Floats]) -> Floats:
    """The highest where somebody sees something, else the lowest: whoever has not looked says nothing."""
    stack = np.stack(layers)
    highest: Floats = stack.max(axis=0)
    lowest: Floats = stack.min(axis=0)
    found: Floats = np.where(highest > SURE, highest, lowest)
    return found


def _spread(mask: Bools, radius_cells: float) -> Bools:
    """All cells whose middle is within ``radius_cells`` of the middle of one in ``mask``."""
    reach = math.floor(radius_cells + 1e-9)
    rows, columns = mask.shape
    wide = np.zeros((rows + 2 * reach, columns + 2 * reach), dtype=bool)
    for up in range(-reach, reach + 1):
        across = math.floor(math.sqrt(max(0.0, radius_cells**2 - up**2)) + 1e-9)
        for shift in range(-across, across + 1):
            wide[reach + up : reach + up + rows, reach + shift : reach + shift + columns] |= mask
    return wide[reach : reach + rows, reach : reach + columns]
