"""Clusters of points on the floor plane."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CELL_M = 0.05
_ROW = 1 << 20
"""Number of cells per row, larger than any room; a cell index is then one integer."""
_AROUND = tuple(across * _ROW + up for across in (-1, 0, 1) for up in (-1, 0, 1) if (across, up) != (0, 0))


@dataclass(frozen=True, slots=True)
class Cluster:
    """Neighbouring points.

    Attributes:
        points_m: Shape (n, 2) or (n, 3) [m].
    """

    points_m: Floats

    @property
    def middle_m(self) -> Floats:
        """Mean x, y of the occupied cells of 5 cm, shape (2,) [m].

        Cells rather than points, because nearer surfaces have more points per area.
        """
        across, up = np.divmod(np.unique(_keys(self.points_m, CELL_M)), _ROW)
        return (np.array([across.mean(), up.mean()]) - _ROW / 2 + 0.5) * CELL_M

    @property
    def height_m(self) -> float:
        """The third highest point [m], to ignore outliers."""
        return float(np.partition(self.points_m[:, 2], -3)[-3]) if len(self.points_m) >= 3 else 0.0  # noqa: PLR2004


def group(points_m: Floats, gap_m: float, min_points: int) -> list[Cluster]:
    """Clusters of points with gaps below about ``gap_m``, largest first.

    Args:
        points_m: Shape (n, 2) or (n, 3) [m].
        gap_m: Cell size for the neighbour search [m].
        min_points: Smallest number of points in a cluster.
    """
    if not len(points_m):
        return []
    keys, cell_of_point = np.unique(_keys(points_m, gap_m), return_inverse=True)
    index = {key: number for number, key in enumerate(keys.tolist())}
    label = np.full(len(keys), -1)
    count = 0
    for key, start in index.items():
        if label[start] >= 0:
            continue
        label[start] = count
        pending = [key]
        while pending:
            cell = pending.pop()
            for step in _AROUND:
                other = index.get(cell + step)
                if other is not None and label[other] < 0:
                    label[other] = count
                    pending.append(cell + step)
        count += 1
    of_point = label[cell_of_point.ravel()]
    clusters = [Cluster(points_m[of_point == number]) for number in range(count)]
    return sorted(
        (cluster for cluster in clusters if len(cluster.points_m) >= min_points),
        key=lambda cluster: -len(cluster.points_m),
    )


def _keys(points_m: Floats, side_m: float) -> NDArray[np.int64]:
    """Cell index of each point, shape (n,)."""
    cells = np.floor(points_m[:, :2] / side_m).astype(np.int64) + _ROW // 2
    clusters: NDArray[np.int64] = cells[:, 0] * _ROW + cells[:, 1]
    return clusters
