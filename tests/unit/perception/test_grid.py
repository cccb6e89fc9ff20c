"""The occupancy grid: what it learns from looks, and what it forgets."""

import math

import numpy as np
import pytest

from device_agent.perception.grid import OccupancyGrid

EMPTY = np.zeros((0, 2))


def room(*boxes):
    """Rays from the middle of a room of 4 by 3 m with boxes (x0, y0, x1, y1) in it: ends, hits."""
    angles = np.linspace(-math.pi, math.pi, 360, endpoint=False)
    ends = []
    for angle in angles:
        along = np.arange(0, 5, 0.005)[:, None] * [math.cos(angle), math.sin(angle)] + [2.0, 1.5]
        hit = (along <= 0).any(axis=1) | (along[:, 0] >= 4) | (along[:, 1] >= 3)
        for x0, y0, x1, y1 in boxes:
            hit |= (along[:, 0] >= x0) & (along[:, 0] <= x1) & (along[:, 1] >= y0) & (along[:, 1] <= y1)
        ends.append(along[int(np.argmax(hit))])
    return np.array(ends)


def look(grid, ends, times=1, elapsed_s=0.1):
    for _ in range(times):
        grid.see_rays("lidar", (2.0, 1.5), ends, np.ones(len(ends), dtype=bool))
        grid.settle(elapsed_s)


def cell(grid, x, y):
    return grid.blocked(0.0).cell(x, y)


def test_walls_are_found_within_a_cell():
    grid = OccupancyGrid((-0.5, -0.5), (4.5, 3.5))
    look(grid, room(), times=50)
    rows, columns = np.nonzero(grid.static())
    x = -0.5 + (columns + 0.5) * 0.05
    y = -0.5 + (rows + 0.5) * 0.05
    off = np.minimum.reduce([abs(x), abs(x - 4), abs(y), abs(y - 3)])
    assert len(off) > 150
    assert off.max() <= 0.05


def test_who_has_left_disappears_and_is_never_furniture():
    grid = OccupancyGrid((-0.5, -0.5), (4.5, 3.5))
    look(grid, room(), times=100)
    person = (3.0, 1.3, 3.3, 1.6)
    look(grid, room(person), times=10)
    at = cell(grid, 3.02, 1.45)
    assert grid.moving()[at]
    assert not grid.static()[at]
    look(grid, room(), times=15)
    assert not grid.taken()[at]


def test_what_stays_becomes_furniture():
    grid = OccupancyGrid((-0.5, -0.5), (4.5, 3.5))
    look(grid, room(), times=100)
    look(grid, room((3.0, 1.3, 3.3, 1.6)), times=90, elapsed_s=1.0)
    assert grid.static()[cell(grid, 3.02, 1.45)]


def test_a_wall_behind_somebody_stays():
    grid = OccupancyGrid((-0.5, -0.5), (4.5, 3.5))
    look(grid, room(), times=100)
    look(grid, room((3.0, 1.0, 3.3, 2.0)), times=40, elapsed_s=0.5)
    assert grid.static()[cell(grid, 4.02, 1.5)]


def test_somebody_who_went_where_nobody_looks_is_forgotten():
    grid = OccupancyGrid((0, 0), (4, 3))
    grid.see_places("depth", taken_m=EMPTY, clear_m=np.array([[1.0, 1.0]]))
    for _ in range(50):
        grid.settle(0.1)
    for _ in range(5):
        grid.see_places("depth", taken_m=np.array([[1.0, 1.0]]), clear_m=EMPTY)
        grid.settle(0.1)
    assert grid.taken()[cell(grid, 1.0, 1.0)]
    for _ in range(300):
        grid.settle(0.1)
    assert not grid.taken()[cell(grid, 1.0, 1.0)]


def test_a_table_that_the_lidar_looks_through_is_taken():
    grid = OccupancyGrid((0, 0), (4, 3))
    table = np.array([[3.0, 1.5]])
    for _ in range(10):
        look(grid, room(), times=1)
        grid.see_places("depth", taken_m=table, clear_m=EMPTY)
    assert grid.taken()[cell(grid, 3.0, 1.5)]


def test_blocked_keeps_the_radius_from_walls():
    grid = OccupancyGrid((-0.5, -0.5), (4.5, 3.5))
    look(grid, room(), times=10)
    floor = grid.blocked(0.25)
    assert floor.at(3.8, 1.5)
    assert not floor.at(3.65, 1.5)
    assert not floor.at(1.0, 1.0)
    assert floor.at(9.0, 1.0), "outside of the grid"
    assert floor.at(-0.4, 1.0), "behind the wall nobody has looked"
    assert not grid.blocked(0.1, unknown=False).at(-0.4, 1.0)


def test_a_robot_does_not_block_itself():
    grid = OccupancyGrid((-0.5, -0.5), (4.5, 3.5))
    look(grid, room((2.8, 1.4, 3.0, 1.6)), times=10)
    assert grid.blocked(0.2).at(2.7, 1.5)
    assert not grid.blocked(0.2, apart=[(2.9, 1.5, 0.3)]).at(2.7, 1.5)


def test_what_is_no_number_is_let_go():
    grid = OccupancyGrid((0, 0), (4, 3))
    grid.see_places("depth", taken_m=np.array([[math.nan, 1.0], [math.inf, 1.0], [1.0, 1.0]]), clear_m=EMPTY)
    assert grid.taken().sum() == 1


def test_a_grid_without_size_is_refused():
    with pytest.raises(ValueError, match="upper corner"):
        OccupancyGrid((0, 0), (0, 3))


def test_somebody_seen_again_and_again_where_the_floor_is_hidden_is_no_furniture():
    grid = OccupancyGrid((0, 0), (4, 3))
    for _ in range(10):
        for _ in range(10):  # two seconds there, eighteen not
            grid.see_places("depth", taken_m=np.array([[1.0, 1.0]]), clear_m=EMPTY)
            grid.settle(0.2)
        for _ in range(90):
            grid.settle(0.2)
        assert not grid.taken()[cell(grid, 1.0, 1.0)]
        assert not grid.static()[cell(grid, 1.0, 1.0)]


def test_nobody_plans_a_way_through_the_walls_of_the_plan():
    grid = OccupancyGrid((-0.5, -0.5), (4.5, 3.5), plan=(0.0, 0.0, 4.0, 3.0))
    for unknown in (True, False):
        grid.see_places("depth", taken_m=EMPTY, clear_m=np.array([[0.3, 1.0], [0.15, 1.0], [-0.2, 1.0]]))
        floor = grid.blocked(0.2, unknown=unknown)
        assert not floor.at(0.3, 1.0)
        assert floor.at(0.15, 1.0)
        assert floor.at(-0.2, 1.0)
