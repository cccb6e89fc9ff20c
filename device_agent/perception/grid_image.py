"""The occupancy grid and the objects in the room as an image, y upwards."""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from device_agent.perception.object_classes import ObjectPosition
from device_agent.perception.occupancy_grid import OccupancyGrid

Pixels = NDArray[np.uint8]

SCALE = 4
"""Pixels per cell side."""
UNKNOWN, FREE, STATIC, MOVING = (205, 205, 205), (255, 255, 255), (45, 52, 64), (240, 150, 60)
MARKS = ((208, 40, 40), (30, 110, 200), (30, 150, 90), (140, 70, 180), (190, 120, 20), (0, 140, 150))
"""Colours of objects, in the order of their names."""
_MARK_M = 0.12


def draw(grid: OccupancyGrid, positions: Mapping[str, ObjectPosition] | None = None) -> Pixels:
    """The grid from above, y upwards, shape (height, width, 3).

    White is free, grey unknown, dark static, orange moving. A disc marks an object, with a line in its heading.
    """
    cells = np.full((*grid.shape, 3), UNKNOWN, dtype=np.uint8)
    cells[~grid.blocked(0.0).blocked] = FREE
    cells[grid.moving()] = MOVING
    cells[grid.static()] = STATIC
    picture = np.ascontiguousarray(np.kron(cells[::-1], np.ones((SCALE, SCALE, 1), dtype=np.uint8)))
    for index, (_, position) in enumerate(sorted((positions or {}).items())):
        _mark(picture, grid, position, MARKS[index % len(MARKS)])
    return picture


def _mark(picture: Pixels, grid: OccupancyGrid, position: ObjectPosition, colour: tuple[int, int, int]) -> None:
    per_m = SCALE / grid.resolution_m
    column = (position.x_m - grid.lower_m[0]) * per_m
    row = picture.shape[0] - (position.y_m - grid.lower_m[1]) * per_m
    rows, columns = np.ogrid[: picture.shape[0], : picture.shape[1]]
    radius = _MARK_M * per_m
    picture[(rows - row) ** 2 + (columns - column) ** 2 <= radius**2] = colour
    if position.yaw_rad is not None:
        for along in np.arange(0.0, 3 * radius, 0.5):
            at = round(row - along * math.sin(position.yaw_rad)), round(column + along * math.cos(position.yaw_rad))
            if 1 <= at[0] < picture.shape[0] - 1 and 1 <= at[1] < picture.shape[1] - 1:
                picture[at[0] - 1 : at[0] + 1, at[1] - 1 : at[1] + 1] = colour
