"""Port: obstacles on the floor, for navigation. The implementer's manual."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class FloorMap(Protocol):
    """Cells that the centre of a round base must not enter. Row 0 is at the lowest y, column 0 at the lowest x."""

    @property
    def blocked(self) -> NDArray[np.bool_]:
        """Blocked cells, shape (rows, columns)."""

    def cell(self, x_m: float, y_m: float) -> tuple[int, int]:
        """Row and column of a position in the room; may be outside of the map."""

    def centre(self, row: int, column: int) -> tuple[float, float]:
        """x, y of the centre of a cell in the room [m]."""


class ObstacleMap(Protocol):
    """Current obstacles in the room, as its sensors detect them. Thread-safe."""

    def blocked(
        self, radius_m: float, *, apart: Sequence[tuple[float, float, float]] = (), unknown: bool = True
    ) -> FloorMap:
        """Positions where a round base would touch an obstacle.

        Args:
            radius_m: Radius of the base [m].
            apart: x, y, radius of areas whose obstacles are ignored, such as the robot itself [m].
            unknown: Whether unobserved cells are blocked.
        """
