"""Located people and robots, compared with their true positions in a simulated room."""

import math
import statistics

import numpy as np
import pytest

from device_agent.perception.background_model import BackgroundModel, BackgroundModelError
from tests.unit.device_agent.perception.playground import (
    ARM_M,
    FURNITURE,
    LOWER_M,
    UPPER_M,
    Playground,
    sight,
    survey,
    watch,
)

pytestmark = pytest.mark.slow
MEDIAN_M = 0.15
"""Promised median position error."""


@pytest.fixture(scope="module")
def empty():
    return BackgroundModel.from_bytes(survey().to_bytes())


LONG = [pytest.mark.long, pytest.mark.timeout(900)]


@pytest.mark.parametrize(("seed", "seconds"), [(1, 40), *(pytest.param(seed, 240, marks=LONG) for seed in range(1, 6))])
def test_positions_are_within_the_promise_while_all_move(empty, seed, seconds):
    ground, eyes = Playground(seed), sight(empty)
    errors_m: dict[str, list[float]] = {}
    missed: list[str] = []
    unexpected: list[str] = []

    def compare(ground, eyes):
        places = eyes.positions(ground.time_s)
        truth = {name: (walker.x_m, walker.y_m) for name, walker in ground.walkers.items() if ground.in_view(name)}
        truth["arm"] = ARM_M
        for name, at in truth.items():
            if name in places:
                errors_m.setdefault(name, []).append(math.dist(at, (places[name].x_m, places[name].y_m)))
            elif ground.time_s > 10:
                missed.append(name)
        unexpected.extend(name for name in places if name not in {*ground.walkers, "arm"})

    watch(ground, eyes, seconds, each=compare)
    looks = sum(map(len, errors_m.values()))
    for name in ("person", "nao", "qbo", "arm"):
        assert statistics.median(errors_m[name]) <= MEDIAN_M, name
    assert len(missed) <= 0.03 * looks
    assert len(unexpected) <= 0.05 * looks


def test_an_empty_room_has_no_people(empty):
    ground, eyes = Playground(3), sight(empty)
    ground.clear()
    for look in range(50):
        eyes.update("lidar", ground.scan())
        eyes.update("depth", ground.depth())
        ground.time_s = look * 0.2
        assert not eyes.positions(ground.time_s)
    assert not any(eyes.presence(ground.time_s).values())


def test_presence_follows_a_person_from_zone_to_zone_and_out(empty):
    ground, eyes = Playground(4), sight(empty)
    ground.clear()
    ground.walkers = {"person": ground.walkers["person"]}
    person = ground.walkers["person"]
    person._rest_s = math.inf
    for x_m, west, east in ((-1.2, 1.0, 0.0), (1.2, 0.0, 1.0)):
        person.x_m, person.y_m = x_m, 0.0
        watch(ground, eyes, 8)
        found = eyes.presence(ground.time_s)
        assert (found["people.west"], found["people.east"], found["people"]) == (west, east, 1.0)
        assert (found["present.west"], found["present.east"]) == (bool(west), bool(east))
    person.x_m = 50.0
    watch(ground, eyes, 6)
    assert eyes.presence(ground.time_s)["people"] == 0.0
    assert "person" not in eyes.positions(ground.time_s)


def resting_qbo(empty, seed, watched_s):
    """A playground whose Qbo rests, its perception after some time, and the walker."""
    ground, eyes = Playground(seed), sight(empty)
    qbo = ground.walkers["qbo"]
    qbo._rest_s = math.inf
    watch(ground, eyes, watched_s)
    return ground, eyes, qbo


def test_a_carried_robot_is_located_again_and_an_occluded_one_keeps_its_position(empty):
    ground, eyes, qbo = resting_qbo(empty, 6, 6)
    qbo.x_m, qbo.y_m = 0.6, 0.9
    watch(ground, eyes, 4)
    place = eyes.positions(ground.time_s)["qbo"]
    assert math.dist((place.x_m, place.y_m), (0.6, 0.9)) < MEDIAN_M
    qbo.x_m = 50.0
    watch(ground, eyes, 5)
    last = eyes.positions(ground.time_s)["qbo"]
    assert math.dist((last.x_m, last.y_m), (place.x_m, place.y_m)) < 0.3
    assert last.age_s > 4


def test_yaw_is_known_after_the_first_motion(empty):
    ground, eyes, qbo = resting_qbo(empty, 7, 4)
    assert eyes.positions(ground.time_s)["qbo"].yaw_rad is None
    qbo._rest_s, qbo.x_m, qbo.y_m, qbo._goal = 0.0, 1.4, -0.9, (1.4, 0.9)
    watch(ground, eyes, 4)
    assert eyes.positions(ground.time_s)["qbo"].yaw_rad == pytest.approx(math.pi / 2, abs=0.3)


def test_readings_that_are_not_finite_are_ignored(empty):
    ground, eyes = Playground(8), sight(empty)
    scan, image = ground.scan(), ground.depth()
    scan.range_m[::3] = math.nan
    assert image.depth_m is not None
    image.depth_m[::3] = math.nan
    eyes.update("lidar", scan)
    eyes.update("depth", image)
    eyes.advance(1.0)
    assert all(place.finite for place in eyes.positions(1.0).values())
    assert np.isfinite(eyes.grid.probability()).all()


def test_the_static_grid_has_furniture_but_no_people(empty):
    ground, eyes = Playground(9), sight(empty)
    for name in ("nao", "qbo"):
        ground.walkers[name].x_m = 50.0
        ground.walkers[name]._rest_s = math.inf
    watch(ground, eyes, 40)
    static = eyes.grid.static()
    rows, columns = np.nonzero(static)
    x, y = eyes.grid.lower_m[0] + (columns + 0.5) * 0.05, eyes.grid.lower_m[1] + (rows + 0.5) * 0.05
    off_m = np.minimum.reduce([x - LOWER_M[0], UPPER_M[0] - x, y - LOWER_M[1], UPPER_M[1] - y])
    for (middle_x, middle_y, _), (half_x, half_y, _) in FURNITURE.values():
        outside = np.maximum(abs(x - middle_x) - half_x, 0), np.maximum(abs(y - middle_y) - half_y, 0)
        off_m = np.minimum(off_m, np.hypot(*outside))
    assert np.mean(off_m <= 0.1) > 0.97, "static cells away from walls and furniture"
    floor = eyes.grid.blocked(0.1, unknown=False)
    for place in ((-0.4, -0.4), (1.0, -1.0), (-1.5, 0.5)):
        assert not static[floor.cell(*place)]
    for place in ((-1.4, 2.1), (0.9, -2.1), (-2.6, 0.8)):  # desk, cupboard, shelf
        assert floor.at(*place)


def test_a_moved_sensor_has_no_background_and_an_invalid_file_is_rejected(empty):
    ground, moved = Playground(1), BackgroundModel()
    scan = ground.scan()
    assert empty.foreground("lidar", scan) is not None
    scan.position_m[0] += 0.1
    assert empty.foreground("lidar", scan) is None
    moved.add("lidar", ground.scan())
    moved.add("lidar", scan)
    with pytest.raises(BackgroundModelError, match="moved"):
        moved.fit()
    with pytest.raises(BackgroundModelError, match="take a new one"):
        BackgroundModel.from_bytes(b"PK nonsense")


def test_people_are_filtered_out_of_the_background():
    ground, found = Playground(2), BackgroundModel()
    for _ in range(60):
        ground.step(1.0)
        found.add("depth", ground.depth())
    found.fit()
    ground.clear()
    assert found.change_share("depth", ground.depth()) < 0.02
