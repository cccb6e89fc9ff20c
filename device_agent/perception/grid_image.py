"""The occupancy grid as a picture: north up, with who is where."""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from device_agent.perception.object_classes import Place
from device_agent.perception.occupancy_grid import OccupancyGrid

Pixels = NDArray[np.uint8]

SCALE = 4
"""Pixels along the side of a cell."""
UNKNOWN, FREE, STATIC, MOVING = (205, 205, 205), (255, 255, 255), (45, 52, 64), (240, 150, 60)
MARKS = ((208, 40, 40), (30, 110, 200), (30, 150, 90), (140, 70, 180), (190, 120, 20), (0, 140, 150))
"""Colours of those who are somewhere, in the order of their names."""
_MARK_M = 0.12


def draw(grid: OccupancyGrid, places: Mapping[str, Place] | None = None) -> Pixels:
    """The grid seen from above, y upwards, shape (height, width, 3).

    White is free, grey unknown, dark what belongs to the room, orange what is there now. A disc is somebody, with a
    line to where he goes.
    """
    cells = np.full((*grid.shape, 3), UNKNOWN, dtype=np.uint8)
    cells[~grid.blocked(0.0).blocked] = FREE
    cells[grid.moving()] = MOVING
    cells[grid.static()] = STATIC
    picture = np.ascontiguousarray(np.kron(cells[::-1], np.ones((SCALE, SCALE, 1), dtype=np.uint8)))
    for index, (_, place) in enumerate(sorted((places or {}).items())):
        _mark(picture, grid, place, MARKS[index % len(MARKS)])
    return picture


def _mark(picture: Pixels, grid: OccupancyGrid, place: Place, colour: tuple[int, int, int]) -> None:
    per_m = SCALE / grid.resolution_m
    column = (place.x_m - grid.lower_m[0]) * per_m
    row = picture.shape[0] - (place.y_m - grid.lower_m[1]) * per_m
    rows, columns = np.ogrid[: picture.shape[0], : picture.shape[1]]
    radius = _MARK_M * per_m
    picture[(rows - row) ** 2 + (columns - column) ** 2 <= radius**2] = colour
    if place.yaw_rad is not None:
        for along in np.arange(0.0, 3 * radius, 0.5):
            at = round(row - along * math.sin(place.yaw_rad)), round(column + along * math.cos(place.yaw_rad))
            if 1 <= at[0] < picture.shape[0] - 1 and 1 <= at[1] < picture.shape[1] - 1:
                picture[at[0] - 1 : at[0] + 1, at[1] - 1 : at[1] + 1] = colour
