"""Where people and robots are, by sensors alone: against the truth of a simulated room."""

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

MEDIAN_M = 0.15
"""What issue 5 promises."""


@pytest.fixture(scope="module")
def empty():
    return BackgroundModel.from_bytes(survey().to_bytes())


def errors(empty, seed, seconds):
    """Position errors by name, undetected objects in view, and unexpected names."""
    ground, eyes = Playground(seed), sight(empty)
    found: dict[str, list[float]] = {}
    missed: list[str] = []
    strange: list[str] = []

    def compare(ground, eyes):
        places = eyes.positions(ground.time_s)
        truth = {name: (one.x_m, one.y_m) for name, one in ground.walkers.items() if ground.in_view(name)}
        truth["arm"] = ARM_M
        for name, at in truth.items():
            if name in places:
                found.setdefault(name, []).append(math.dist(at, (places[name].x_m, places[name].y_m)))
            elif ground.time_s > 10:
                missed.append(name)
        strange.extend(name for name in places if name not in {*ground.walkers, "arm"})

    watch(ground, eyes, seconds, each=compare)
    return found, missed, strange


def check(found, missed, strange):
    looks = sum(map(len, found.values()))
    for name in ("person", "nao", "qbo", "arm"):
        error = found[name]
        print(f"{name}: median {statistics.median(error):.3f} m, 95 % {np.percentile(error, 95):.3f} m, {len(error)}")
        assert statistics.median(error) <= MEDIAN_M
    print(f"missed {len(missed)}, strange {len(strange)} of {looks}")
    assert len(missed) <= 0.03 * looks
    assert len(strange) <= 0.05 * looks


def test_positions_are_within_the_promise_while_all_move(empty):
    check(*errors(empty, seed=1, seconds=40))


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize("seed", range(1, 6))
def test_positions_are_within_the_promise_for_minutes(empty, seed):
    check(*errors(empty, seed=seed, seconds=240))


def test_an_empty_room_has_no_people(empty):
    ground, eyes = Playground(3), sight(empty)
    ground.clear()
    for look in range(50):
        eyes.update("lidar", ground.scan())
        eyes.update("depth", ground.depth())
        ground.time_s = look * 0.2
        assert not eyes.positions(ground.time_s)
    assert eyes.presence(ground.time_s) == {
        "people": 0.0,
        "people.west": 0.0,
        "present.west": False,
        "people.east": 0.0,
        "present.east": False,
    }


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


def test_an_occluded_robot_keeps_its_position_and_ages(empty):
    ground, eyes = Playground(5), sight(empty)
    robot = ground.walkers["qbo"]
    robot._rest_s = math.inf
    watch(ground, eyes, 6)
    at = robot.x_m, robot.y_m
    robot.x_m = 50.0
    watch(ground, eyes, 5)
    place = eyes.positions(ground.time_s)["qbo"]
    assert math.dist((place.x_m, place.y_m), at) < 0.3
    assert place.age_s > 4


def test_a_carried_robot_is_located_again(empty):
    ground, eyes = Playground(6), sight(empty)
    robot = ground.walkers["qbo"]
    robot._rest_s = math.inf
    watch(ground, eyes, 6)
    robot.x_m, robot.y_m = 0.6, 0.9
    watch(ground, eyes, 4)
    place = eyes.positions(ground.time_s)["qbo"]
    assert math.dist((place.x_m, place.y_m), (0.6, 0.9)) < MEDIAN_M


def test_yaw_is_known_after_the_first_motion(empty):
    ground, eyes = Playground(7), sight(empty)
    robot = ground.walkers["qbo"]
    robot._rest_s = math.inf
    watch(ground, eyes, 4)
    assert eyes.positions(ground.time_s)["qbo"].yaw_rad is None
    robot._rest_s, robot.x_m, robot.y_m, robot._goal = 0.0, 1.4, -0.9, (1.4, 0.9)
    watch(ground, eyes, 4)
    yaw_rad = eyes.positions(ground.time_s)["qbo"].yaw_rad
    assert yaw_rad is not None
    assert abs(yaw_rad - math.pi / 2) < 0.3


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


def outside_of(x, y):
    """How far places are from the nearest wall or piece of furniture [m]; 0 inside."""
    off = np.minimum.reduce([x - LOWER_M[0], UPPER_M[0] - x, y - LOWER_M[1], UPPER_M[1] - y])
    for (middle_x, middle_y, _), (half_x, half_y, _) in FURNITURE.values():
        off = np.minimum(
            off, np.hypot(np.maximum(abs(x - middle_x) - half_x, 0), np.maximum(abs(y - middle_y) - half_y, 0))
        )
    return np.maximum(off, 0)


def test_the_static_grid_has_furniture_but_no_people(empty):
    ground, eyes = Playground(9), sight(empty)
    robots = {name: ground.walkers[name] for name in ("nao", "qbo")}
    for robot in robots.values():
        robot.x_m = 50.0
        robot._rest_s = math.inf
    watch(ground, eyes, 40)
    static = eyes.grid.static()
    rows, columns = np.nonzero(static)
    off = outside_of(eyes.grid.lower_m[0] + (columns + 0.5) * 0.05, eyes.grid.lower_m[1] + (rows + 0.5) * 0.05)
    print(f"{len(off)} cells, {np.mean(off <= 0.05):.3f} within 0.05 m, {np.mean(off <= 0.1):.3f} within 0.1 m")
    assert np.mean(off <= 0.1) > 0.97
    floor = eyes.grid.blocked(0.1, unknown=False)
    for x, y in ((-0.4, -0.4), (1.0, -1.0), (-1.5, 0.5)):
        assert not static[floor.cell(x, y)]
    for x, y in ((-1.4, 2.1), (0.9, -2.1), (-2.6, 0.8)):  # desk, cupboard, shelf
        assert floor.at(x, y)


def test_an_invalid_background_file_is_rejected():
    with pytest.raises(BackgroundModelError, match="take a new one"):
        BackgroundModel.from_bytes(b"PK nonsense")


def test_a_moved_sensor_has_no_background(empty):
    ground = Playground(1)
    scan = ground.scan()
    assert empty.foreground("lidar", scan) is not None
    scan.position_m[0] += 0.1
    assert empty.foreground("lidar", scan) is None
    found = BackgroundModel()
    found.add("lidar", ground.scan())
    found.add("lidar", scan)
    with pytest.raises(BackgroundModelError, match="moved"):
        found.fit()


def test_people_are_filtered_out_of_the_background():
    ground, found = Playground(2), BackgroundModel()
    for _ in range(60):
        ground.step(1.0)
        found.add("depth", ground.depth())
    found.fit()
    ground.clear()
    assert found.change_share("depth", ground.depth()) < 0.02
