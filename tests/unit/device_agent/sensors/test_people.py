"""Live depth, scans and tracked people of the simulated laboratory."""

import math
import shutil
from pathlib import Path
from typing import Any

import msgspec
import mujoco
import numpy as np
import pytest

from device_agent.ports.sensor import Camera, Image, Scan, SensorError
from device_agent.protocol import CameraStream, TrackedPeople, TrackedPerson
from device_agent.protocol.manifests import room
from device_agent.sensors.mujoco.people_tracker import FURTHEST_M, INFERRED_M, NEAREST_M
from device_agent.simulation.room import skeleton
from tests.harness.agent.rooms import LAB, ManualWorld
from tests.harness.network.cameras.frames import depths_mm, people, scan

pytestmark = pytest.mark.slow
ROUND_S = 34
STANDING_S = 9.0
"""The person stands at the second corner of its path, in view of the camera."""
WALL = '<geom class="lab_look" type="box" size="0.02 1.2 {height}" pos="{x} {y} {height}" euler="0 0 2.54"/>'
"""A wall across the line from the camera to the standing person."""


def laboratory(folder: Path = LAB) -> ManualWorld:
    """The laboratory without robots, which is faster."""
    return ManualWorld(folder, msgspec.structs.replace(room.load(folder), robots=()))


def walled(folder: Path, **values: float) -> ManualWorld:
    """The laboratory with a wall."""
    shutil.copytree(LAB, folder / "lab")
    model = folder / "lab" / "room.xml"
    model.write_text(model.read_text().replace("</worldbody>", WALL.format(**values) + "</worldbody>"))
    return laboratory(folder / "lab")


def camera(world: ManualWorld, name: str = "depth") -> Camera:
    driver = world.driver(name)
    driver.connect()
    assert isinstance(driver, Camera)
    return driver


def tracked(driver: Camera) -> TrackedPeople:
    frame = driver.frame("people")
    assert frame is not None
    found = people(frame.content)
    assert (frame.width, frame.height, frame.kind) == (len(found.people), 1, "people")
    return found


def standing(world: ManualWorld) -> TrackedPerson | None:
    world.advance(STANDING_S)
    found = tracked(camera(world)).people
    assert len(found) <= 1
    return found[0] if found else None


def states(person: TrackedPerson | None) -> dict[str, str]:
    assert person is not None, "the person is not tracked"
    return {joint.name: joint.state for joint in person.joints}


def truth_m(world: ManualWorld) -> Any:
    (person,) = skeleton.find(world.model)
    data = mujoco.MjData(world.model)
    world.copy(data)
    return person.positions_m(data)


def pixel(seen: Any, place_m: Any) -> tuple[int, int, float]:
    """Row, column and depth [m] of a place in a camera's picture of 320 x 240."""
    x, y, z = np.array(seen.rotation).T @ (np.array(place_m) - np.array(seen.position_m))
    focal = 120 / math.tan(seen.fovy_rad / 2)
    return round(120 - focal * y / -z), round(160 + focal * x / -z), -z


def test_a_person_keeps_its_id_in_view_and_gets_a_new_one_afterwards() -> None:
    world = laboratory()
    driver = camera(world)
    ids: list[int] = []
    for _ in range(2 * 3 * ROUND_S):
        world.advance(0.5)
        found = tracked(driver)
        distance_m = pixel(found, (*world.place("person")[:2], 0.95))[2]
        for person in found.people:
            assert NEAREST_M - 0.3 < distance_m < FURTHEST_M + 0.3
            assert math.dist(person.position_m[:2], world.place("person")[:2]) < 6 * INFERRED_M
            ids.append(person.id)
        assert found.people or distance_m > FURTHEST_M - 0.4 or distance_m < 2.0, "near the camera parts are outside"
    assert ids == sorted(ids)
    assert set(ids) == set(range(1, max(ids) + 1))
    assert 2 <= max(ids) <= 6, "a person that walks out of view returns with a new id"


def test_joints_are_tracked_only_where_the_depth_image_shows_the_person() -> None:
    world = laboratory()
    driver = camera(world)
    compared = 0
    for _ in range(ROUND_S):
        world.advance(1.0)
        found = tracked(driver)
        image = driver.raw()
        assert isinstance(image, Image)
        assert image.depth_m is not None
        for joint in (joint for person in found.people for joint in person.joints if joint.state == "tracked"):
            true_m = truth_m(world)[skeleton.JOINTS.index(joint.name)]
            row, column, depth_m = pixel(found, true_m)
            patch = image.depth_m[max(0, row - 3) : row + 4, max(0, column - 3) : column + 4]
            assert patch.max() > depth_m - 0.3, f"{joint.name} is behind something"
            compared += 1
    assert compared > 100


def test_a_person_behind_a_wall_is_not_tracked(tmp_path: Path) -> None:
    assert standing(walled(tmp_path, x=1.6, y=0.75, height=1.3)) is None


def test_a_person_behind_a_low_wall_has_inferred_legs(tmp_path: Path) -> None:
    legs = ("knee_left", "knee_right", "ankle_left", "ankle_right")
    free, hidden = states(standing(laboratory())), states(standing(walled(tmp_path, x=0.9, y=1.25, height=0.45)))
    assert {free[name] for name in legs[:2]} == {"tracked"}
    assert {hidden[name] for name in legs} == {"inferred"}
    assert {hidden[name] for name in ("head", "shoulder_center", "spine")} == {"tracked"}


def test_joints_have_the_noise_of_their_state() -> None:
    world = laboratory()
    world.advance(STANDING_S)
    driver = camera(world)
    frames = [tracked(driver) for _ in range(400)]
    joints = [frame.people[0].joints for frame in frames]
    positions = np.array([[joint.position_m for joint in each] for each in joints])
    names = [joint.name for joint in joints[0]]
    true_m = truth_m(world)[[skeleton.JOINTS.index(name) for name in names]]
    for index, joint in enumerate(joints[0]):
        depth_m = pixel(frames[0], true_m[index])[2]
        deviation_m = INFERRED_M if joint.state == "inferred" else 0.0012 + 0.0019 * (depth_m - 0.4) ** 2
        error_m = positions[:, index] - true_m[index]
        assert error_m.std() == pytest.approx(deviation_m, rel=0.15), joint.name
        assert np.abs(error_m.mean(axis=0)).max() < 5 * deviation_m / math.sqrt(len(frames)), joint.name
    assert {joint.state for joint in joints[0]} == {"tracked", "inferred"}


def test_a_depth_stream_has_the_noise_of_the_camera() -> None:
    world = laboratory()
    driver = camera(world, "depth_ceiling")
    contents = [frame.content for frame in (driver.frame("depth") for _ in range(40)) if frame is not None]
    assert max(map(len, contents)) < 100_000
    images = np.array([depths_mm(content) for content in contents]) / 1000
    known = (images > 0).all(axis=0)
    assert known.mean() > 0.9
    mean, spread = images[:, known].mean(axis=0), images[:, known].std(axis=0)
    assert np.median(spread / (0.0012 + 0.0019 * (mean - 0.4) ** 2)) == pytest.approx(1.0, abs=0.1)


def test_a_scan_stream_shows_what_a_capture_shows() -> None:
    driver = camera(laboratory(), "lidar")
    frame = driver.frame("scan")
    assert frame is not None
    streamed, captured = scan(frame.content), scan(driver.capture("scan").content)
    assert (frame.width, streamed.position_m, streamed.rotation, streamed.angle_rad) == (
        360, captured.position_m, captured.rotation, captured.angle_rad,
    )  # fmt: skip
    for one, other in zip(streamed.range_m, captured.range_m, strict=True):
        assert (one is None) == (other is None)
        assert one is None or other is None or one == pytest.approx(other, abs=0.1 + 0.1 * other), "only noise differs"
    assert isinstance(driver.raw(), Scan)


def test_a_simulated_sensor_rejects_other_kinds_and_names() -> None:
    world = laboratory()
    for name, kind in (("lidar", "depth"), ("camera", "people"), ("pir", "scan"), ("depth", "colour")):
        wrong = (CameraStream(name="view", rate_hz=1.0, kind=kind),)
        with pytest.raises(SensorError, match=f"camera 'view' of '{name}' has the kind '{kind}'"):
            world.driver(msgspec.structs.replace(world.entry(name), cameras=wrong))
    driver = camera(world)
    with pytest.raises(SensorError, match="no camera 'other'; it has: depth, people"):
        driver.frame("other")
