"""The occupancy grid as measurements: what a script reads without fetching a file.

A stream carries numbers by name. So each row of the floor is one whole number, whose bits are its places from the
lowest x on: exact as a float up to 53 places.
"""

import math

import numpy as np
from numpy.typing import NDArray

from device_agent.perception.occupancy_grid import OccupancyGrid

Bools = NDArray[np.bool_]

SIDE_M = 0.2
"""Side of a place [m]: less than a robot, and few enough for a message. Larger in rooms that are larger than this:"""
MOST_COLUMNS, MOST_ROWS = 48, 48
"""Two numbers for each row are 96 of the 128 values that a measurement may have."""


def rows(grid: OccupancyGrid) -> dict[str, float]:
    """The floor in places of about 0.2 m.

    A place is taken where anything in it is, and unknown where any of it is unknown, as what lies beyond the walls.

    Returns:
        ``lower_x_m``, ``lower_y_m``: the lowest corner in the room; ``side_m`` of a place; ``columns`` along x and
        ``rows`` along y; ``taken_bits.{row}`` and ``unknown_bits.{row}``, 1 of which is the place with the lowest x.
    """
    high, wide = grid.shape
    cells = max(round(SIDE_M / grid.resolution_m), math.ceil(wide / MOST_COLUMNS), math.ceil(high / MOST_ROWS), 1)
    taken = grid.taken()
    unknown = grid.blocked(0.0).blocked & ~taken
    places = _any(taken, cells)
    found = {
        "lower_x_m": grid.lower_m[0],
        "lower_y_m": grid.lower_m[1],
        "side_m": round(cells * grid.resolution_m, 6),
        "columns": float(places.shape[1]),
        "rows": float(places.shape[0]),
    }
    found |= _bits("taken_bits", places)
    return found | _bits("unknown_bits", _any(unknown, cells) & ~places)


def _bits(name: str, mask: Bools) -> dict[str, float]:
    values = mask @ 2.0 ** np.arange(mask.shape[1])
    return {f"{name}.{row}": value for row, value in enumerate(values.tolist())}


def _any(mask: Bools, cells: int) -> Bools:
    """Whether any of each square of so many cells is in the mask."""
    high, wide = (math.ceil(size / cells) for size in mask.shape)
    whole = np.zeros((high * cells, wide * cells), dtype=bool)
    whole[: mask.shape[0], : mask.shape[1]] = mask
    found: Bools = np.any(whole.reshape(high, cells, wide, cells), axis=(1, 3))
    return found
