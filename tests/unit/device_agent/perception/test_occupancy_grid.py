"""The occupancy grid: updates, decay and navigation maps."""

import math

import numpy as np
import pytest

from device_agent.perception.grid_rows import occupancy_rows
from device_agent.perception.occupancy_grid import OccupancyGrid
from device_agent.protocol import MAX_VALUES, Measurements, codec
from device_agent.sandbox import api

EMPTY = np.zeros((0, 2))
PERSON = (3.0, 1.3, 3.3, 1.6)


def room(*boxes):
    """End points of rays from the middle of a room of 4 by 3 m with boxes (x0, y0, x1, y1) in it."""
    ends = []
    for angle in np.linspace(-math.pi, math.pi, 360, endpoint=False):
        along = np.arange(0, 5, 0.005)[:, None] * [math.cos(angle), math.sin(angle)] + [2.0, 1.5]
        hit = (along <= 0).any(axis=1) | (along >= [4, 3]).any(axis=1)
        for x0, y0, x1, y1 in boxes:
            hit |= ((along >= [x0, y0]) & (along <= [x1, y1])).all(axis=1)
        ends.append(along[int(np.argmax(hit))])
    return np.array(ends)


def add_scans(grid, ends, times=1, elapsed_s=0.1):
    for _ in range(times):
        grid.add_rays("lidar", (2.0, 1.5), ends, np.ones(len(ends), dtype=bool))
        grid.advance(elapsed_s)


def cell(grid, x, y):
    return grid.blocked(0.0).cell(x, y)


@pytest.fixture
def grid():
    return OccupancyGrid((-0.5, -0.5), (4.5, 3.5))


@pytest.fixture
def exact_grid():
    """A grid as large as the room."""
    return OccupancyGrid((0, 0), (4, 3))


def test_walls_are_found_within_a_cell(grid):
    add_scans(grid, room(), times=50)
    rows, columns = np.nonzero(grid.static())
    x = -0.5 + (columns + 0.5) * 0.05
    y = -0.5 + (rows + 0.5) * 0.05
    off = np.minimum.reduce([abs(x), abs(x - 4), abs(y), abs(y - 3)])
    assert len(off) > 150
    assert off.max() <= 0.05


def test_a_person_who_leaves_disappears(grid):
    add_scans(grid, room(), times=100)
    add_scans(grid, room(PERSON), times=10)
    at = cell(grid, 3.02, 1.45)
    assert grid.moving()[at]
    assert not grid.static()[at]
    add_scans(grid, room(), times=15)
    assert not grid.taken()[at]


def test_objects_that_stay_become_static_and_the_wall_behind_them_stays(grid):
    add_scans(grid, room(), times=100)
    add_scans(grid, room(PERSON), times=90, elapsed_s=1.0)
    assert grid.static()[cell(grid, 3.02, 1.45)]
    assert grid.static()[cell(grid, 4.02, 1.5)]


def test_unseen_cells_decay_to_unknown(exact_grid):
    exact_grid.add_cells("depth", taken_m=EMPTY, clear_m=np.array([[1.0, 1.0]]))
    for _ in range(50):
        exact_grid.advance(0.1)
    for _ in range(5):
        exact_grid.add_cells("depth", taken_m=np.array([[1.0, 1.0]]), clear_m=EMPTY)
        exact_grid.advance(0.1)
    assert exact_grid.taken()[cell(exact_grid, 1.0, 1.0)]
    for _ in range(300):
        exact_grid.advance(0.1)
    assert not exact_grid.taken()[cell(exact_grid, 1.0, 1.0)]


def test_a_table_above_the_lidar_plane_is_occupied(exact_grid):
    table = np.array([[3.0, 1.5]])
    for _ in range(10):
        add_scans(exact_grid, room(), times=1)
        exact_grid.add_cells("depth", taken_m=table, clear_m=EMPTY)
    assert exact_grid.taken()[cell(exact_grid, 3.0, 1.5)]


def test_blocked_keeps_the_radius_from_walls(grid):
    add_scans(grid, room(), times=10)
    floor = grid.blocked(0.25)
    assert floor.at(3.8, 1.5)
    assert not floor.at(3.65, 1.5)
    assert not floor.at(1.0, 1.0)
    assert floor.at(9.0, 1.0), "outside of the grid"
    assert floor.at(-0.4, 1.0), "unknown behind the wall"
    assert not grid.blocked(0.1, unknown=False).at(-0.4, 1.0)
    add_scans(grid, room((2.8, 1.4, 3.0, 1.6)), times=10)
    assert grid.blocked(0.2).at(2.7, 1.5)
    assert not grid.blocked(0.2, apart=[(2.9, 1.5, 0.3)]).at(2.7, 1.5), "a robot does not block itself"


def test_invalid_points_and_sizes_are_rejected(exact_grid):
    exact_grid.add_cells("depth", taken_m=np.array([[math.nan, 1.0], [math.inf, 1.0], [1.0, 1.0]]), clear_m=EMPTY)
    assert exact_grid.taken().sum() == 1
    with pytest.raises(ValueError, match="upper corner"):
        OccupancyGrid((0, 0), (0, 3))


def test_people_in_front_of_hidden_floor_do_not_become_static(exact_grid):
    for _ in range(10):
        for _ in range(10):  # occupied for two of twenty seconds
            exact_grid.add_cells("depth", taken_m=np.array([[1.0, 1.0]]), clear_m=EMPTY)
            exact_grid.advance(0.2)
        for _ in range(90):
            exact_grid.advance(0.2)
        assert not exact_grid.taken()[cell(exact_grid, 1.0, 1.0)]
        assert not exact_grid.static()[cell(exact_grid, 1.0, 1.0)]


def test_cells_outside_the_plan_are_blocked():
    grid = OccupancyGrid((-0.5, -0.5), (4.5, 3.5), plan=(0.0, 0.0, 4.0, 3.0))
    for unknown in (True, False):
        grid.add_cells("depth", taken_m=EMPTY, clear_m=np.array([[0.3, 1.0], [0.15, 1.0], [-0.2, 1.0]]))
        floor = grid.blocked(0.2, unknown=unknown)
        assert not floor.at(0.3, 1.0)
        assert floor.at(0.15, 1.0)
        assert floor.at(-0.2, 1.0)


def floor_of(values: dict[str, float]) -> api.Room:
    """A script's room with a recent measurement of the floor."""
    return api.Room(lambda kind, device, stream: {"values": values, "age_s": 0.5})  # noqa: ARG005


def test_scripts_can_decode_the_rows():
    grid = OccupancyGrid((-3.2, -2.7), (3.2, 2.7), plan=(-3.0, -2.5, 3.0, 2.5))
    across, up = np.meshgrid(np.arange(-2.9, 2.9, 0.05), np.arange(-2.4, 1.0, 0.05))
    clear = np.column_stack((across.ravel(), up.ravel()))
    for _ in range(5):
        grid.add_cells("depth", taken_m=np.array([[1.01, -1.0], [-2.5, 0.6]]), clear_m=clear)
    rows = occupancy_rows(grid)
    assert (rows["columns"], rows["rows"], rows["side_m"]) == (32.0, 27.0, 0.2)
    assert len(rows) <= MAX_VALUES
    room = floor_of(rows)
    for x_m, y_m, taken in (
        (1.01, -1.0, True),
        (-2.5, 0.6, True),
        (0.0, 0.0, False),
        (1.5, -1.0, False),
        (0.0, 2.0, None),  # unknown
        (3.1, 0.0, None),  # behind the wall
        (50.0, 0.0, None),
    ):
        assert room.taken(x_m, y_m) is taken, (x_m, y_m)
    with pytest.raises(api.RobotError, match="finite"):
        room.taken(math.nan, 0.0)
    assert api.Room(lambda *_, **__: None).taken(0.0, 0.0) is None
    assert api.Room(lambda *_, **__: {"values": rows, "age_s": 60.0}).taken(0.0, 0.0) is None


@pytest.mark.parametrize("size_m", [6.0, 40.0, 80.0])
def test_rows_of_any_floor_fit_into_a_message(size_m):
    grid = OccupancyGrid((0.0, 0.0), (size_m, size_m * 0.9))
    last = np.array([[size_m - 0.03, size_m * 0.9 - 0.03]])
    grid.add_cells("depth", taken_m=last, clear_m=np.zeros((0, 2)))
    rows = occupancy_rows(grid)
    codec.encode(Measurements(tick_ms=1, at_ms=1, sequence=1, values=rows))
    assert floor_of(rows).taken(*last[0]) is True
