"""Simulated sensors in the laboratory, with realistic errors."""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import TypeVar

import msgspec
import numpy as np
import pytest

from device_agent.ports.sensor import Image, Movable, RoomDriver, Scan, SensorError, Surroundings
from device_agent.protocol import Stream
from device_agent.protocol.manifests import room
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors import load, names
from device_agent.sensors import mujoco as simulated
from device_agent.sensors.mujoco.noise import NOISE, NoiseParameters, SensorNoise, generator
from tests.harness.agent.rooms import LAB, ManualWorld

pytestmark = pytest.mark.slow
ROUND_S = 45.0
"""Longer than one round of the person."""
LEG_M = 0.35


@pytest.fixture
def world() -> ManualWorld:
    """The laboratory without robots, which is faster."""
    return ManualWorld(manifest=msgspec.structs.replace(room.load(LAB), robots=()))


@pytest.fixture
def lab() -> ManualWorld:
    """The laboratory with robots."""
    return ManualWorld()


def connected(world: ManualWorld, device: RoomDeviceManifest | str) -> RoomDriver:
    driver = world.driver(device)
    driver.connect()
    return driver


Raw = TypeVar("Raw", Scan, Image)


def raw(driver: RoomDriver, kind: type[Raw]) -> Raw:
    measured = driver.raw()
    assert isinstance(measured, kind)
    return measured


def until(world: ManualWorld, condition: Callable[[], bool], step_s: float = 0.25) -> None:
    for _ in range(round(ROUND_S / step_s)):
        if condition():
            return
        world.advance(step_s)
    pytest.fail("not within one round of the person")


# ---------------------------------------------------------------- motion


def test_the_motion_detector_only_detects_motion(world: ManualWorld) -> None:
    pir = connected(world, "pir")
    readings: list[tuple[bool, float]] = []
    for _ in range(round(ROUND_S / 0.25)):
        before = world.place("person")
        world.advance(0.25)
        readings.append((bool(pir.read("motion")["present"]), math.dist(before, world.place("person")) / 0.25))
    assert {present for present, _ in readings} == {True, False}
    speeds = [speed for (before, _), (after, speed) in pairwise(readings) if after and not before]
    assert speeds, "no detection"
    assert min(speeds) > 0.1, "false detection"


def test_the_motion_detector_ignores_cold_and_hidden_bodies(world: ManualWorld) -> None:
    entry = world.entry("pir")
    still = connected(world, msgspec.structs.replace(entry, options={"warm": ["chair"]}))
    door = connected(world, msgspec.structs.replace(entry, options={"warm": ["unknown"]}))
    world.set("door", 1.5)
    for _ in range(20):
        world.advance(0.25)
        assert not still.read("motion")["present"]
        assert not door.read("motion")["present"], "the door is not warm"


def test_the_lidar_measures_the_persons_legs(world: ManualWorld) -> None:
    lidar = connected(world, "lidar")
    empty_m = raw(lidar, Scan).range_m
    detections = 0
    for _ in range(40):
        world.advance(1.0)
        scan = raw(lidar, Scan)
        nearer = np.isfinite(scan.range_m) & (scan.range_m < empty_m - 0.25)
        angle_rad = scan.angle_rad[nearer]
        beams = np.stack((np.cos(angle_rad), np.sin(angle_rad), np.zeros_like(angle_rad)), axis=1)
        ends_m = scan.position_m + (beams * scan.range_m[nearer, None]) @ scan.rotation.T
        x, y, _ = world.place("person")
        detections += bool((np.hypot(*(ends_m[:, :2] - (x, y)).T) < LEG_M).any())
    assert detections > 25, f"the person was detected in {detections} of 40 scans"


def test_a_scan_has_noise_and_excludes_the_lidar(world: ManualWorld) -> None:
    lidar = connected(world, "lidar")
    scans = np.array([raw(lidar, Scan).range_m for _ in range(60)])
    known = np.isfinite(scans).all(axis=0)
    assert known.sum() > 200
    mean, spread = scans[:, known].mean(axis=0), scans[:, known].std(axis=0)
    assert np.median(spread / np.maximum(0.005, 0.01 * mean)) == pytest.approx(1.0, abs=0.15)
    assert scans.min() >= 0.15


def test_cameras_show_a_moving_robot(lab: ManualWorld) -> None:
    corner, turning = connected(lab, "camera"), connected(lab, "pan_tilt")
    model = lab.model
    arm = [index for index in range(model.nu) if model.actuator(index).name.startswith("ur5/")]
    for camera in (corner, turning):
        noise = difference(raw(camera, Image), raw(camera, Image))
        before = raw(camera, Image)
        now = lab.world.snapshot().ctrl[arm]
        lab.world.command("test", np.array(arm), now + np.array([1.2, 0.4, -0.6, 0, 0, 0]), ramp_s=1.0)
        lab.advance(2.0)
        after = raw(camera, Image)
        assert difference(before, after) > noise + 20, "the image has not changed"
        camera.close()


def difference(one: Image, other: Image) -> int:
    """Number of pixels that changed by more than noise."""
    assert one.rgb is not None
    assert other.rgb is not None
    return int((np.abs(one.rgb.astype(int) - other.rgb.astype(int)).max(axis=2) > 25).sum())


def test_the_depth_camera_measures_the_person(world: ManualWorld) -> None:
    depth = connected(world, "depth")

    def visible() -> bool:
        """Whether the person's centre is in the image at its true depth."""
        now = raw(depth, Image)
        assert now.depth_m is not None
        height, width = now.depth_m.shape
        x, y, z = now.rotation.T @ (np.array(world.place("person")) - now.position_m)
        focal = height / 2 / math.tan(now.fovy_rad / 2)
        row, column = round(height / 2 - focal * y / -z), round(width / 2 + focal * x / -z)
        if not (5 <= row < height - 5 and 5 <= column < width - 5 and 0.5 < -z < 7):
            return False
        patch = now.depth_m[row - 2 : row + 3, column - 2 : column + 3]
        return bool(abs(np.median(patch) + z) < 0.3)

    until(world, visible)
    depth.close()


def test_depth_is_infinite_out_of_range(world: ManualWorld) -> None:
    near = connected(world, msgspec.structs.replace(world.entry("depth"), options={"furthest_m": 2.0}))
    depth_m = raw(near, Image).depth_m
    assert depth_m is not None
    assert np.isinf(depth_m).any()
    assert depth_m[np.isfinite(depth_m)].max() < 2.1
    near.close()


def test_the_door_follows_its_control_until_held_and_its_contact_reports_it(world: ManualWorld) -> None:
    door, contact = connected(world, "door"), connected(world, "door_contact")
    assert contact.read("contact") == {"open": False}
    assert door.set("opening", 1.0) == pytest.approx(1.0)
    world.advance(1.0)
    assert contact.read("contact") == {"open": True}
    assert isinstance(door, Movable)
    door.hold()
    held = door.read("settings")["opening"]
    assert 0.05 < held < 0.95, "the door moves at limited speed"
    world.advance(5.0)
    assert door.read("settings")["opening"] == pytest.approx(held, abs=0.08)
    door.set("opening", 0.0)
    world.advance(6.0)
    assert contact.read("contact") == {"open": False}


def test_a_pan_tilt_camera_reports_its_pose(world: ManualWorld) -> None:
    camera = connected(world, "pan_tilt")
    before = raw(camera, Image)
    camera.set("pan", 1.0)
    world.advance(5.0)
    after = raw(camera, Image)
    assert camera.read("settings")["pan"] == pytest.approx(1.0, abs=0.03)
    cosine = float(before.rotation[:, 2] @ after.rotation[:, 2])
    assert 0.5 < math.acos(cosine) < 1.2
    assert difference(before, after) > 5000
    camera.close()


def test_the_lamp_changes_the_light_meter(world: ManualWorld) -> None:
    lamp, meter = (
        connected(world, "lamp"),
        connected(world, msgspec.structs.replace(world.entry("light"), options={"seed": 3})),
    )
    lamp.set("level", 0.0)
    world.advance(0.02)
    dark = meter.read("light")["light_lux"]
    lamp.set("level", 1.0)
    world.advance(0.02)
    until(world, lambda: meter.read("light")["light_lux"] > dark + 100, step_s=0.02)


# ---------------------------------------------------------------- noise


def test_noise_is_reproducible_by_seed() -> None:
    errors = NoiseParameters(offset=2.0, jitter=0.5)
    readings = [[SensorNoise(errors, generator("one", seed)).read(20.0, 0.0) for _ in range(3)] for seed in (1, 1, 2)]
    assert readings[0] == readings[1] != readings[2]
    sensors = [SensorNoise(errors, generator("many", seed)) for seed in range(300)]
    offsets = [np.mean([sensor.read(0.0, time_s) for time_s in range(200)]) for sensor in sensors]
    assert np.std(offsets) == pytest.approx(2.0, rel=0.15)


def test_readings_lag_behind_a_step() -> None:
    sensor = SensorNoise(NoiseParameters(lag_s=10.0), generator("slow", 0))
    assert sensor.read(0.0, 0.0) == 0
    assert sensor.read(1.0, 10.0) == pytest.approx(1 - math.exp(-1))
    assert sensor.read(1.0, 100.0) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("quantity", NOISE)
def test_readings_respect_minimum_and_resolution(quantity: str) -> None:
    errors = NOISE[quantity]
    for seed in range(20):
        readings = SensorNoise(errors, generator("many", seed)).read(0.3, 0.0)
        assert readings >= errors.least
        assert readings / errors.step == pytest.approx(round(readings / errors.step), abs=1e-3)


# ---------------------------------------------------------------- invalid configuration


@pytest.mark.parametrize(
    ("device", "changes", "message"),
    [
        ("door_contact", {"kind": "telescope"}, "no kind 'telescope'; it has: camera, .*thermostat"),
        ("door_contact", {"options": {"colour": "red"}}, "no option 'colour'; it has: .*joint"),
        ("door_contact", {"options": {"joint": 3}}, "option 'joint' .* is 3, of the wrong type"),
        ("door_contact", {"options": {"seed": True}}, "option 'seed' .* is True, of the wrong type"),
        ("door_contact", {"options": {"joint": "gate"}}, r"no joint 'gate'; it has: .*door"),
        ("camera", {"options": {"width": 100_000}}, "at most 1920 x 1080"),
    ],
)
def test_an_invalid_entry_is_rejected(
    world: ManualWorld, device: str, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(SensorError, match=message):
        world.driver(msgspec.structs.replace(world.entry(device), **changes)).connect()


def test_unknown_drivers_and_rooms_without_model_are_rejected(world: ManualWorld) -> None:
    with pytest.raises(SensorError, match=r"no sensor driver 'crystal_ball'; there are: .*mujoco"):
        load("crystal_ball")
    assert {"mujoco", "perception"} <= set(names())
    with pytest.raises(SensorError, match="its room has no model"):
        simulated.create(world.entry("pir"), LAB, Surroundings(neighbours={}))


def test_a_missing_quantity_is_reported(world: ManualWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ManualWorld, "quantities", {"temperature_c": 20.0})
    meter = connected(world, msgspec.structs.replace(world.entry("co2"), streams=(Stream(name="co2", rate_hz=1.0),)))
    with pytest.raises(SensorError, match="this room has no co2_ppm; it has: temperature_c"):
        meter.read("co2")
