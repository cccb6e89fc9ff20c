"""Groups of points that belong together, seen from above."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CELL_M = 0.05
_ROW = 1 << 20
"""Cells in a row, more than any room has: so a cell is one whole number."""
_AROUND = tuple(across * _ROW + up for across in (-1, 0, 1) for up in (-1, 0, 1) if (across, up) != (0, 0))


@dataclass(frozen=True, slots=True)
class Cluster:
    """Points near each other.

    Attributes:
        points_m: Shape (n, 2) or (n, 3) [m].
    """

    points_m: Floats

    @property
    def middle_m(self) -> Floats:
        """Mean x, y of its cells of 5 cm, shape (2,) [m]: what is nearer to a sensor has more points, not more room."""
        across, up = np.divmod(np.unique(_keys(self.points_m, CELL_M)), _ROW)
        return (np.array([across.mean(), up.mean()]) - _ROW / 2 + 0.5) * CELL_M

    @property
    def height_m(self) -> float:
        """Of its highest points [m]; a single stray one does not count."""
        return float(np.partition(self.points_m[:, 2], -3)[-3]) if len(self.points_m) >= 3 else 0.0  # noqa: PLR2004


def group(points_m: Floats, gap_m: float, fewest: int) -> list[Cluster]:
    """Points with less than about ``gap_m`` between neighbours, largest group first.

    Args:
        points_m: Shape (n, 2) or (n, 3) [m].
        gap_m: Side of the cells in which neighbours are looked for [m].
        fewest: Groups of fewer points are let go.
    """
    if not len(points_m):
        return []
    keys, belongs = np.unique(_keys(points_m, gap_m), return_inverse=True)
    index = {key: number for number, key in enumerate(keys.tolist())}
    label = np.full(len(keys), -1)
    count = 0
    for key, start in index.items():
        if label[start] >= 0:
            continue
        label[start] = count
        reached = [key]
        while reached:
            here = reached.pop()
            for step in _AROUND:
                other = index.get(here + step)
                if other is not None and label[other] < 0:
                    label[other] = count
                    reached.append(here + step)
        count += 1
    of_point = label[belongs.ravel()]
    found = [Cluster(points_m[of_point == number]) for number in range(count)]
    return sorted((one for one in found if len(one.points_m) >= fewest), key=lambda one: -len(one.points_m))


def _keys(points_m: Floats, side_m: float) -> NDArray[np.int64]:
    """The cell of each point, shape (n,)."""
    cells = np.floor(points_m[:, :2] / side_m).astype(np.int64) + _ROW // 2
    found: NDArray[np.int64] = cells[:, 0] * _ROW + cells[:, 1]
    return found
