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
    SyntheticRoom,
    make_fusion,
    run,
    survey,
)

pytestmark = pytest.mark.slow
MEDIAN_M = 0.15
"""Maximum median position error."""


@pytest.fixture(scope="module")
def empty():
    return BackgroundModel.from_bytes(survey().to_bytes())


LONG = [pytest.mark.long, pytest.mark.timeout(900)]


@pytest.mark.parametrize(("seed", "seconds"), [(1, 40), *(pytest.param(seed, 240, marks=LONG) for seed in range(1, 6))])
def test_positions_are_accurate_while_all_move(empty, seed, seconds):
    scene, fusion = SyntheticRoom(seed), make_fusion(empty)
    errors_m: dict[str, list[float]] = {}
    missed: list[str] = []
    unexpected: list[str] = []

    def compare(scene, fusion):
        positions = fusion.positions(scene.time_s)
        truth = {name: (walker.x_m, walker.y_m) for name, walker in scene.walkers.items() if scene.in_view(name)}
        truth["arm"] = ARM_M
        for name, at in truth.items():
            if name in positions:
                errors_m.setdefault(name, []).append(math.dist(at, (positions[name].x_m, positions[name].y_m)))
            elif scene.time_s > 10:
                missed.append(name)
        unexpected.extend(name for name in positions if name not in {*scene.walkers, "arm"})

    run(scene, fusion, seconds, on_sample=compare)
    samples = sum(map(len, errors_m.values()))
    for name in ("person", "nao", "qbo", "arm"):
        assert statistics.median(errors_m[name]) <= MEDIAN_M, name
    assert len(missed) <= 0.03 * samples
    assert len(unexpected) <= 0.05 * samples


def test_an_empty_room_has_no_people(empty):
    scene, fusion = SyntheticRoom(3), make_fusion(empty)
    scene.clear()
    for index in range(50):
        fusion.update("lidar", scene.scan())
        fusion.update("depth", scene.depth())
        scene.time_s = index * 0.2
        assert not fusion.positions(scene.time_s)
    assert not any(fusion.presence(scene.time_s).values())


def test_presence_follows_a_person_from_zone_to_zone_and_out(empty):
    scene, fusion = SyntheticRoom(4), make_fusion(empty)
    scene.clear()
    scene.walkers = {"person": scene.walkers["person"]}
    person = scene.walkers["person"]
    person._rest_s = math.inf
    for x_m, west, east in ((-1.2, 1.0, 0.0), (1.2, 0.0, 1.0)):
        person.x_m, person.y_m = x_m, 0.0
        run(scene, fusion, 8)
        presence = fusion.presence(scene.time_s)
        assert (presence["people.west"], presence["people.east"], presence["people"]) == (west, east, 1.0)
        assert (presence["present.west"], presence["present.east"]) == (bool(west), bool(east))
    person.x_m = 50.0
    run(scene, fusion, 6)
    assert fusion.presence(scene.time_s)["people"] == 0.0
    assert "person" not in fusion.positions(scene.time_s)


def resting_qbo(empty, seed, duration_s):
    """A room whose Qbo rests, its perception after ``duration_s``, and the walker."""
    scene, fusion = SyntheticRoom(seed), make_fusion(empty)
    qbo = scene.walkers["qbo"]
    qbo._rest_s = math.inf
    run(scene, fusion, duration_s)
    return scene, fusion, qbo


def test_a_carried_robot_is_located_again_and_an_occluded_one_keeps_its_position(empty):
    scene, fusion, qbo = resting_qbo(empty, 6, 6)
    qbo.x_m, qbo.y_m = 0.6, 0.9
    run(scene, fusion, 4)
    place = fusion.positions(scene.time_s)["qbo"]
    assert math.dist((place.x_m, place.y_m), (0.6, 0.9)) < MEDIAN_M
    qbo.x_m = 50.0
    run(scene, fusion, 5)
    last = fusion.positions(scene.time_s)["qbo"]
    assert math.dist((last.x_m, last.y_m), (place.x_m, place.y_m)) < 0.3
    assert last.age_s > 4


def test_yaw_is_known_after_the_first_motion(empty):
    scene, fusion, qbo = resting_qbo(empty, 7, 4)
    assert fusion.positions(scene.time_s)["qbo"].yaw_rad is None
    qbo._rest_s, qbo.x_m, qbo.y_m, qbo._goal = 0.0, 1.4, -0.9, (1.4, 0.9)
    run(scene, fusion, 4)
    assert fusion.positions(scene.time_s)["qbo"].yaw_rad == pytest.approx(math.pi / 2, abs=0.3)


def test_readings_that_are_not_finite_are_ignored(empty):
    scene, fusion = SyntheticRoom(8), make_fusion(empty)
    scan, image = scene.scan(), scene.depth()
    scan.range_m[::3] = math.nan
    assert image.depth_m is not None
    image.depth_m[::3] = math.nan
    fusion.update("lidar", scan)
    fusion.update("depth", image)
    fusion.advance(1.0)
    assert all(place.finite for place in fusion.positions(1.0).values())
    assert np.isfinite(fusion.grid.probability()).all()


def test_the_static_grid_has_furniture_but_no_people(empty):
    scene, fusion = SyntheticRoom(9), make_fusion(empty)
    for name in ("nao", "qbo"):
        scene.walkers[name].x_m = 50.0
        scene.walkers[name]._rest_s = math.inf
    run(scene, fusion, 40)
    static = fusion.grid.static()
    rows, columns = np.nonzero(static)
    x, y = fusion.grid.lower_m[0] + (columns + 0.5) * 0.05, fusion.grid.lower_m[1] + (rows + 0.5) * 0.05
    off_m = np.minimum.reduce([x - LOWER_M[0], UPPER_M[0] - x, y - LOWER_M[1], UPPER_M[1] - y])
    for (middle_x, middle_y, _), (half_x, half_y, _) in FURNITURE.values():
        outside = np.maximum(abs(x - middle_x) - half_x, 0), np.maximum(abs(y - middle_y) - half_y, 0)
        off_m = np.minimum(off_m, np.hypot(*outside))
    assert np.mean(off_m <= 0.1) > 0.97, "static cells away from walls and furniture"
    floor = fusion.grid.blocked(0.1, unknown=False)
    for place in ((-0.4, -0.4), (1.0, -1.0), (-1.5, 0.5)):
        assert not static[floor.cell(*place)]
    for place in ((-1.4, 2.1), (0.9, -2.1), (-2.6, 0.8)):  # desk, cupboard, shelf
        assert floor.at(*place)


def test_a_moved_sensor_has_no_background_and_an_invalid_file_is_rejected(empty):
    scene, moved = SyntheticRoom(1), BackgroundModel()
    scan = scene.scan()
    assert empty.foreground("lidar", scan) is not None
    scan.position_m[0] += 0.1
    assert empty.foreground("lidar", scan) is None
    moved.add("lidar", scene.scan())
    moved.add("lidar", scan)
    with pytest.raises(BackgroundModelError, match="moved"):
        moved.fit()
    with pytest.raises(BackgroundModelError, match="take a new one"):
        BackgroundModel.from_bytes(b"PK nonsense")


def test_people_are_filtered_out_of_the_background():
    scene, background = SyntheticRoom(2), BackgroundModel()
    for _ in range(60):
        scene.step(1.0)
        background.add("depth", scene.depth())
    background.fit()
    scene.clear()
    assert background.change_share("depth", scene.depth()) < 0.02
