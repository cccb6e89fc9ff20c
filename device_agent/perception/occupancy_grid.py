"""An occupancy grid of the room's floor, from lidar scans and depth images.

Each sensor has its own layer, because sensors see different heights: a lidar looks below a table that a camera sees
from above. A cell is occupied if it is occupied in one layer.

Each layer has two arrays of log odds. The *recent* one follows each sample within a second. The *lasting* one follows
the recent one within a minute; an unseen cell decays to it. An object that has left thus disappears, and a wall behind
an object stays.
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
"""Log odds that one sample adds: hits weigh more than passing rays, which may miss thin objects."""
LIMIT = 4.0
"""Limit of the log odds, a probability of 0.98, so that changes are learned quickly."""
OBSTACLE_WEIGHT = 3.0
"""Weight of a point above the floor relative to a floor point."""
FADE_S = 2.0
"""Time constant with which unseen cells decay to the lasting layer [s]."""
LASTING_S = 60.0
"""Time constant of the lasting layer [s]; in the first minute it is the mean of all samples,"""
YOUNG_S = 10.0
"""over at least this time [s], so that people present at the start do not become static."""
HIDDEN_S = 120.0
"""Time constant with which unseen cells decay in the lasting layer [s]. Otherwise a cell that is only visible while
occupied would stay occupied."""
SURE = 0.4
"""Log odds above which a cell counts as occupied, or below the negative of which as free."""
STATIC = 1.0
"""Log odds of the lasting layer above which a cell counts as static."""


@dataclass(slots=True)
class _Layer:
    """State of one sensor, arrays of shape (rows, columns)."""

    recent: Floats
    lasting: Floats
    seen: Bools
    age_s: float = 0.0


@dataclass(frozen=True, slots=True)
class GridFloorMap:
    """Cells that the centre of a round object must not enter. Immutable.

    Row 0 is at the lowest y, column 0 at the lowest x of the room.

    Attributes:
        blocked: Shape (rows, columns).
        lower_m: x, y of the grid's lowest corner in the room [m].
        resolution_m: Cell size [m].
    """

    blocked: Bools
    lower_m: tuple[float, float]
    resolution_m: float

    def cell(self, x_m: float, y_m: float) -> tuple[int, int]:
        """Row and column of a point in the room; may be outside the grid."""
        column = math.floor((x_m - self.lower_m[0]) / self.resolution_m)
        row = math.floor((y_m - self.lower_m[1]) / self.resolution_m)
        return row, column

    def centre(self, row: int, column: int) -> tuple[float, float]:
        """x, y of a cell's centre in the room [m]."""
        return (self.lower_m[0] + (column + 0.5) * self.resolution_m, self.lower_m[1] + (row + 0.5) * self.resolution_m)

    def at(self, x_m: float, y_m: float) -> bool:
        """Whether a point is blocked; points outside the grid are."""
        row, column = self.cell(x_m, y_m)
        rows, columns = self.blocked.shape
        return not (0 <= row < rows and 0 <= column < columns) or bool(self.blocked[row, column])


@dataclass(slots=True)
class OccupancyGrid:
    """The room's floor in cells. Thread-safe: one thread writes, any number read.

    To plan a path for a robot of radius 0.25 m at (x, y) that the sensors see, too::

        floor = grid.blocked(0.25, apart=[(x, y, 0.35)])
        floor.at(1.0, 2.0)

    Attributes:
        lower_m: Lowest corner x, y in the room [m].
        upper_m: Highest corner [m].
        resolution_m: Cell size [m].
        plan: Lowest x, y and highest x, y within the walls, if known [m]; everything outside is blocked.
    """

    lower_m: tuple[float, float]
    upper_m: tuple[float, float]
    resolution_m: float = RESOLUTION_M
    plan: tuple[float, float, float, float] | None = None
    _layers: dict[str, _Layer] = field(default_factory=dict, init=False, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.resolution_m <= 0 or any(high <= low for low, high in zip(self.lower_m, self.upper_m, strict=True)):
            raise ValueError("resolution_m must be above 0, and the upper corner above the lower one")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows (along y) and columns (along x)."""
        across, up = (
            math.ceil((high - low) / self.resolution_m - 1e-9)
            for low, high in zip(self.lower_m, self.upper_m, strict=True)
        )
        return up, across

    # ------------------------------------------------------------ input

    def add_rays(self, sensor: str, origin_m: Sequence[float], ends_m: Floats, hit: Bools) -> None:
        """Add rays parallel to the floor, as of a lidar.

        Args:
            sensor: Name of the layer.
            origin_m: x, y of their start [m].
            ends_m: Their ends, shape (n, 2) [m].
            hit: Whether a ray hit something, shape (n,); otherwise it is free up to its end.
        """
        origin = np.asarray(origin_m[:2], dtype=np.float64)
        offsets = ends_m - origin
        length = np.hypot(offsets[:, 0], offsets[:, 1])
        if not length.size:
            return
        # Do not clear the last cell before a hit: the obstacle may fill a part of it.
        clear = length - np.where(hit, self.resolution_m, 0.0)
        steps = np.arange(0.0, float(length.max()) + 1e-9, self.resolution_m)
        ray, step = np.nonzero(steps[None, :] < clear[:, None])
        points = origin + (offsets / np.maximum(length, 1e-9)[:, None])[ray] * steps[step, None]
        self.add_cells(sensor, taken_m=ends_m[hit], clear_m=points)

    def add_points(self, sensor: str, points_m: Floats, taken: Bools) -> None:
        """Add points; a cell is occupied if at least a quarter of its points are obstacles.

        A camera that looks below a desk sees floor there, and the desk's top above it.

        Args:
            sensor: Name of the layer.
            points_m: Shape (n, 2) [m]; points outside the grid are ignored.
            taken: Whether a point is an obstacle, shape (n,); otherwise it is floor.
        """
        cells, inside = self._cells(points_m)
        size = self.shape[0] * self.shape[1]
        votes = np.bincount(cells, np.where(taken[inside], OBSTACLE_WEIGHT, -1.0), size)
        seen = np.bincount(cells, minlength=size) > 0
        self._update(sensor, (seen & (votes > 0)).reshape(self.shape), (seen & (votes <= 0)).reshape(self.shape))

    def add_cells(self, sensor: str, *, taken_m: Floats, clear_m: Floats) -> None:
        """Add occupied and free points. A cell with both is occupied.

        Args:
            sensor: Name of the layer.
            taken_m: Shape (n, 2) [m]; points outside the grid are ignored.
            clear_m: Shape (m, 2) [m].
        """
        taken, clear = self._mask(taken_m), self._mask(clear_m)
        self._update(sensor, taken, clear & ~taken)

    def _update(self, sensor: str, taken: Bools, clear: Bools) -> None:
        with self._lock:
            layer = self._layer(sensor)
            layer.recent[taken] = np.minimum(layer.recent[taken] + TAKEN, LIMIT)
            layer.recent[clear] = np.maximum(layer.recent[clear] + CLEAR, -LIMIT)
            layer.seen |= taken | clear

    def advance(self, elapsed_s: float) -> None:
        """Advance time: lasting layers learn from new samples, unseen cells decay."""
        with self._lock:
            for layer in self._layers.values():
                layer.age_s += elapsed_s
                learn = min(1.0, elapsed_s / min(LASTING_S, max(YOUNG_S, layer.age_s)))
                layer.lasting[layer.seen] += learn * (layer.recent - layer.lasting)[layer.seen]
                unseen = ~layer.seen
                layer.lasting[unseen] *= math.exp(-elapsed_s / HIDDEN_S)
                # Cells that were occupied only briefly decay to unknown.
                target = np.where(np.abs(layer.lasting) > STATIC, layer.lasting, np.minimum(layer.lasting, 0.0))
                keep = math.exp(-elapsed_s / FADE_S)
                layer.recent[unseen] = (target + keep * (layer.recent - target))[unseen]
                layer.seen[:] = False

    # ------------------------------------------------------------ output

    def probability(self) -> Floats:
        """Probability of current occupancy, shape (rows, columns); 0.5 if unknown."""
        recent, _ = self._log_odds()
        result: Floats = 1.0 / (1.0 + np.exp(-recent))
        return result

    def taken(self) -> Bools:
        """Cells that are occupied now, shape (rows, columns)."""
        return self._log_odds()[0] > SURE

    def static(self) -> Bools:
        """Cells that have been occupied for long and still are, such as walls and furniture, shape (rows, columns).

        Includes their edges, which not every sample hits.
        """
        recent, lasting = self._log_odds()
        taken = recent > SURE
        return taken & _dilated(taken & (lasting > STATIC), 1.0)

    def moving(self) -> Bools:
        """Cells that are occupied now but are not static, shape (rows, columns)."""
        return self.taken() & ~self.static()

    def blocked(self, radius_m: float, *, apart: Sequence[Circle] = (), unknown: bool = True) -> GridFloorMap:
        """Cells where a round object of this radius would touch an obstacle.

        Args:
            radius_m: Radius of the object, including its safety distance [m].
            apart: Circles in which obstacles are ignored: the robot itself.
            unknown: Whether unknown cells are blocked, too. Gaps of one cell next to free cells are not.
        """
        recent, _ = self._log_odds()
        taken, free = recent > SURE, recent < -SURE
        for x_m, y_m, apart_m in apart:
            circle = self._circle(x_m, y_m, apart_m)
            taken &= ~circle
            free |= circle
        taken |= self._walls()
        blocked = _dilated(taken, radius_m / self.resolution_m)
        if unknown:
            blocked |= ~(taken | _dilated(free, 1.0))
        blocked.setflags(write=False)
        return GridFloorMap(blocked, self.lower_m, self.resolution_m)

    # ------------------------------------------------------------ internal

    def _layer(self, sensor: str) -> _Layer:
        if sensor not in self._layers:
            self._layers[sensor] = _Layer(np.zeros(self.shape), np.zeros(self.shape), np.zeros(self.shape, dtype=bool))
        return self._layers[sensor]

    def _log_odds(self) -> tuple[Floats, Floats]:
        """Recent and lasting log odds over all layers, shape (rows, columns)."""
        with self._lock:
            if not self._layers:
                return np.zeros(self.shape), np.zeros(self.shape)
            recent = _combined([layer.recent for layer in self._layers.values()])
            return recent, _combined([layer.lasting for layer in self._layers.values()])

    def _mask(self, points_m: Floats) -> Bools:
        mask = np.zeros(self.shape, dtype=bool)
        mask.ravel()[self._cells(points_m)[0]] = True
        return mask

    def _cells(self, points_m: Floats) -> tuple[NDArray[np.int64], Bools]:
        """Flat cell indices of the points in the grid, and a mask of those points, shape (n,). NaN is outside."""
        rows, columns = self.shape
        across, up = ((points_m - self.lower_m) / self.resolution_m).T
        inside: Bools = (across >= 0) & (across < columns) & (up >= 0) & (up < rows)
        return up[inside].astype(np.int64) * columns + across[inside].astype(np.int64), inside

    def _walls(self) -> Bools:
        """Cells outside the plan, shape (rows, columns)."""
        walls = np.zeros(self.shape, dtype=bool)
        if self.plan is not None:
            across, up = self._centres()
            low_x, low_y, high_x, high_y = self.plan
            walls |= ((across < low_x) | (across > high_x))[None, :] | ((up < low_y) | (up > high_y))[:, None]
        return walls

    def _centres(self) -> tuple[Floats, Floats]:
        """Centre of each column along x, and of each row along y [m]."""
        rows, columns = self.shape
        across: Floats = self.lower_m[0] + (np.arange(columns, dtype=np.float64) + 0.5) * self.resolution_m
        up: Floats = self.lower_m[1] + (np.arange(rows, dtype=np.float64) + 0.5) * self.resolution_m
        return across, up

    def _circle(self, x_m: float, y_m: float, radius_m: float) -> Bools:
        across, up = self._centres()
        across, up = across - x_m, up - y_m
        result: Bools = up[:, None] ** 2 + across[None, :] ** 2 <= radius_m**2
        return result


def _combined(layers: list[Floats]) -> Floats:
    """The highest value if one layer is occupied, else the lowest; layers without data have 0."""
    stack = np.stack(layers)
    highest: Floats = stack.max(axis=0)
    lowest: Floats = stack.min(axis=0)
    result: Floats = np.where(highest > SURE, highest, lowest)
    return result


def _dilated(mask: Bools, radius_cells: float) -> Bools:
    """Cells within ``radius_cells`` of a cell in ``mask``, between centres."""
    reach = math.floor(radius_cells + 1e-9)
    rows, columns = mask.shape
    wide = np.zeros((rows + 2 * reach, columns + 2 * reach), dtype=bool)
    for up in range(-reach, reach + 1):
        across = math.floor(math.sqrt(max(0.0, radius_cells**2 - up**2)) + 1e-9)
        for shift in range(-across, across + 1):
            wide[reach + up : reach + up + rows, reach + shift : reach + shift + columns] |= mask
    return wide[reach : reach + rows, reach : reach + columns]
