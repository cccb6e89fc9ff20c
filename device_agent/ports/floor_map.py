"""What a robot that goes over the floor asks of whoever knows the room. This page is the implementer's manual."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class FloorMap(Protocol):
    """Where the middle of something round must not be, in cells. Row 0 is at the lowest y, column 0 at the lowest x."""

    @property
    def blocked(self) -> NDArray[np.bool_]:
        """Shape (rows, columns)."""

    def cell(self, x_m: float, y_m: float) -> tuple[int, int]:
        """Row and column of a place in the room; may lie outside."""

    def centre(self, row: int, column: int) -> tuple[float, float]:
        """x, y of the middle of a cell in the room [m]."""


class ObstacleMap(Protocol):
    """What stands and goes about in the room, as its sensors see it now. Thread-safe."""

    def blocked(
        self, radius_m: float, *, apart: Sequence[tuple[float, float, float]] = (), unknown: bool = True
    ) -> FloorMap:
        """Where something round with this radius would touch what is there.

        Args:
            radius_m: Of whoever wants to go there [m].
            apart: x, y, radius of places where what is there does not count: the robot itself [m].
            unknown: Whether what nobody has seen is blocked too.
        """
