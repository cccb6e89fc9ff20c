"""The occupancy grid as measurements, readable by scripts without a file transfer.

A stream carries named numbers, so each row of the floor is one integer whose bits are cells, lowest x first. Floats
represent up to 53 bits exactly.
"""

import math

import numpy as np
from numpy.typing import NDArray

from device_agent.perception.occupancy_grid import OccupancyGrid

Bools = NDArray[np.bool_]

SIDE_M = 0.2
"""Cell size of the rows [m]; larger in large rooms, limited by:"""
MAX_COLUMNS, MAX_ROWS = 48, 48
"""Two numbers per row are 96 of the 128 values of a measurement."""


def occupancy_rows(grid: OccupancyGrid) -> dict[str, float]:
    """The floor in cells of about 0.2 m.

    A cell is occupied if any grid cell in it is, and unknown if any is unknown, as outside the walls.

    Returns:
        ``lower_x_m``, ``lower_y_m``: the lowest corner in the room; ``side_m`` of a cell; ``columns`` along x and
        ``rows`` along y; ``taken_bits.{row}`` and ``unknown_bits.{row}``, where bit 0 is the cell with the lowest x.
    """
    high, wide = grid.shape
    cells = max(round(SIDE_M / grid.resolution_m), math.ceil(wide / MAX_COLUMNS), math.ceil(high / MAX_ROWS), 1)
    taken = grid.taken()
    unknown = grid.blocked(0.0).blocked & ~taken
    occupied = _any(taken, cells)
    values = {
        "lower_x_m": grid.lower_m[0],
        "lower_y_m": grid.lower_m[1],
        "side_m": round(cells * grid.resolution_m, 6),
        "columns": float(occupied.shape[1]),
        "rows": float(occupied.shape[0]),
    }
    values |= _bits("taken_bits", occupied)
    return values | _bits("unknown_bits", _any(unknown, cells) & ~occupied)


def _bits(name: str, mask: Bools) -> dict[str, float]:
    values = mask @ 2.0 ** np.arange(mask.shape[1])
    return {f"{name}.{row}": value for row, value in enumerate(values.tolist())}


def _any(mask: Bools, cells: int) -> Bools:
    """Whether any cell of each square of ``cells`` x ``cells`` is set."""
    high, wide = (math.ceil(size / cells) for size in mask.shape)
    whole = np.zeros((high * cells, wide * cells), dtype=bool)
    whole[: mask.shape[0], : mask.shape[1]] = mask
    values: Bools = np.any(whole.reshape(high, cells, wide, cells), axis=(1, 3))
    return values
