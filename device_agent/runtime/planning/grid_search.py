"""Shortest path over the free cells of a floor map (A*)."""

import heapq
import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from device_agent.ports.floor_map import FloorMap
from device_agent.runtime.errors import Refused

_ITERATIONS = 16
"""Cells by which the reachable area grows between two checks."""
_MAX_ESCAPE_M = 0.4
"""A robot that is too close to an obstacle leaves straight to a free cell within this distance [m]."""
_NEIGHBOURS = [(row, column, math.hypot(row, column)) for row in (-1, 0, 1) for column in (-1, 0, 1) if row or column]

_Cell = tuple[int, int]
_Point = tuple[float, float]


def find_path(floor: FloorMap, start: _Point, goal: _Point) -> list[_Point]:
    """The shortest path over free cells as points in the room [m]; the last one is the goal.

    Raises:
        Refused: The goal is occupied, outside or unreachable. The text names the nearest reachable place.
    """
    free, start_cell, goal_cell = ~floor.blocked, floor.cell(*start), floor.cell(*goal)
    for name, cell in (("The robot", start_cell), ("The goal", goal_cell)):
        if not all(0 <= at < size for at, size in zip(cell, free.shape, strict=True)):
            raise Refused("out_of_room", f"{name} is outside of the known part of the room")
    start_cell = _escape(floor, free, start_cell, start)
    reachable = _reachable(free, start_cell)
    if not reachable[goal_cell]:
        raise _unreachable(floor, reachable, goal, occupied=not free[goal_cell])
    previous: dict[_Cell, _Cell] = {start_cell: start_cell}
    cost = {start_cell: 0.0}
    heap = [(math.dist(start_cell, goal_cell), start_cell)]
    while True:
        _, cell = heapq.heappop(heap)
        if cell == goal_cell:
            return [*_points(floor, previous, goal_cell), goal]
        for row, column, length in _NEIGHBOURS:
            neighbour = cell[0] + row, cell[1] + column
            neighbour_cost = cost[cell] + length
            if _is_free(free, neighbour) and neighbour_cost < cost.get(neighbour, math.inf):
                cost[neighbour], previous[neighbour] = neighbour_cost, cell
                heapq.heappush(heap, (neighbour_cost + math.dist(neighbour, goal_cell), neighbour))


def _unreachable(floor: FloorMap, reachable: NDArray[np.bool_], goal: _Point, *, occupied: bool) -> Refused:
    why = "the place is occupied, too close to an obstacle or unobserved" if occupied else "there is no free path to it"
    nearest = ""
    if reachable.any():
        x_m, y_m = floor.centre(*_nearest(floor, reachable, goal))
        nearest = f"; the nearest reachable place is x_m {x_m:.2f}, y_m {y_m:.2f}"
    return Refused("taken" if occupied else "no_way", f"cannot go to that place: {why}{nearest}")


def _escape(floor: FloorMap, free: NDArray[np.bool_], cell: _Cell, point: _Point) -> _Cell:
    """The start of a path: the robot's cell, or the nearest free one if the robot is too close to an obstacle."""
    if free[cell] or not free.any():
        return cell
    nearest = _nearest(floor, free, point)
    return nearest if math.dist(floor.centre(*nearest), point) <= _MAX_ESCAPE_M else cell


def _nearest(floor: FloorMap, cells: NDArray[np.bool_], point: _Point) -> _Cell:
    """The nearest of the marked cells."""
    rows, columns = np.nonzero(cells)
    row, column = floor.cell(*point)
    index = int(np.argmin((rows - row) ** 2 + (columns - column) ** 2))
    return int(rows[index]), int(columns[index])


def _reachable(free: NDArray[np.bool_], start: _Cell) -> NDArray[np.bool_]:
    """The free cells with a path from the start, shape (rows, columns)."""
    reachable = np.zeros_like(free)
    reachable[start] = True
    before = 0
    while before != (count := int(reachable.sum())):
        before = count
        for _ in range(_ITERATIONS):
            vertical = reachable.copy()
            vertical[1:] |= reachable[:-1]
            vertical[:-1] |= reachable[1:]
            grown = vertical.copy()
            grown[:, 1:] |= vertical[:, :-1]
            grown[:, :-1] |= vertical[:, 1:]
            reachable |= grown & free
    reachable &= free
    return reachable


def _is_free(free: NDArray[np.bool_], cell: _Cell) -> bool:
    inside = 0 <= cell[0] < free.shape[0] and 0 <= cell[1] < free.shape[1]
    return inside and bool(free[cell])


def _points(floor: FloorMap, previous: Mapping[_Cell, _Cell], goal: _Cell) -> list[_Point]:
    cells = [goal]
    while previous[cells[-1]] != cells[-1]:
        cells.append(previous[cells[-1]])
    return [floor.centre(*cell) for cell in reversed(cells)]
