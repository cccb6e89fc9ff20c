"""Simulated sensors in the laboratory, with realistic errors."""

import math
from collections.abc import Callable
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from device_agent.ports.sensor import Image, RoomDriver, Scan, SensorError, Surroundings
from device_agent.protocol import Stream
from device_agent.protocol.manifests import room
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors import load, names
from device_agent.sensors import mujoco as simulated
from device_agent.sensors.mujoco import cameras, shared_view
from device_agent.sensors.mujoco.noise import NOISE, NoiseParameters, SensorNoise, generator
from tests.harness.agent.rooms import LAB, StillWorld

ROUND_S = 45.0
"""Longer than one round of the person."""
LEG_M = 0.35


@pytest.fixture(autouse=True)
def present(monkeypatch: pytest.MonkeyPatch) -> None:
    """No cached views: time is manual."""
    monkeypatch.setattr(shared_view, "OLDEST_S", -1.0)
    monkeypatch.setattr(cameras, "FRESH_S", -1.0)


@pytest.fixture
def world() -> StillWorld:
    """The laboratory without robots, which is faster."""
    return StillWorld(manifest=msgspec.structs.replace(room.load(LAB), robots=()))


@pytest.fixture
def lab() -> StillWorld:
    """The laboratory with robots."""
    return StillWorld()


def connected(world: StillWorld, device: RoomDeviceManifest | str) -> RoomDriver:
    driver = world.driver(device)
    driver.connect()
    return driver


def changed(device: RoomDeviceManifest, **fields: object) -> RoomDeviceManifest:
    return msgspec.structs.replace(device, **fields)


def scan(driver: RoomDriver) -> Scan:
    raw = driver.raw()
    assert isinstance(raw, Scan)
    return raw


def image(driver: RoomDriver) -> Image:
    raw = driver.raw()
    assert isinstance(raw, Image)
    return raw


def until(world: StillWorld, wanted: Callable[[], bool], step_s: float = 0.25) -> None:
    for _ in range(round(ROUND_S / step_s)):
        if wanted():
            return
        world.go_on(step_s)
    pytest.fail("not within one round of the person")


def hits_of(scan: Scan) -> np.ndarray:
    """End points of the beams that hit something, shape (m, 2) [m]."""
    seen = np.isfinite(scan.range_m)
    beams = np.stack((np.cos(scan.angle_rad), np.sin(scan.angle_rad), np.zeros_like(scan.angle_rad)), axis=1)
    points: np.ndarray = scan.position_m + (beams * np.where(seen, scan.range_m, 0)[:, None]) @ scan.rotation.T
    return points[seen, :2]


# ---------------------------------------------------------------- motion


def test_the_motion_detector_only_detects_motion(world: StillWorld) -> None:
    pir = connected(world, "pir")
    readings: list[tuple[bool, float]] = []
    for _ in range(round(ROUND_S / 0.25)):
        before = world.place("person")
        world.go_on(0.25)
        readings.append((bool(pir.read("motion")["present"]), math.dist(before, world.place("person")) / 0.25))
    assert {present for present, _ in readings} == {True, False}
    speeds = [speed for (before, _), (after, speed) in pairwise(readings) if after and not before]
    assert speeds, "no detection"
    assert min(speeds) > 0.1, "false detection"


def test_the_motion_detector_ignores_cold_and_hidden_bodies(world: StillWorld) -> None:
    entry = world.entry("pir")
    still = connected(world, changed(entry, options={"warm": ["chair"]}))
    door = connected(world, changed(entry, options={"warm": ["unknown"]}))
    world.set("door", 1.5)
    for _ in range(20):
        world.go_on(0.25)
        assert not still.read("motion")["present"]
        assert not door.read("motion")["present"], "the door is not warm"


def test_the_lidar_measures_the_persons_legs(world: StillWorld) -> None:
    lidar = connected(world, "lidar")
    empty = scan(lidar).range_m
    seen = 0
    for _ in range(40):
        world.go_on(1.0)
        now = scan(lidar)
        x, y, _ = world.place("person")
        nearer = np.isfinite(now.range_m) & (now.range_m < empty - 0.25)
        points = hits_of(now)[nearer[np.isfinite(now.range_m)]]
        distance_m = np.hypot(*(points - (x, y)).T)
        seen += bool((distance_m < LEG_M).any())
    assert seen > 25, f"the person was met in {seen} of 40 scans"


def test_a_scan_has_noise_and_excludes_the_lidar(world: StillWorld) -> None:
    lidar = connected(world, "lidar")
    scans = np.array([scan(lidar).range_m for _ in range(60)])
    known = np.isfinite(scans).all(axis=0)
    assert known.sum() > 200
    mean, spread = scans[:, known].mean(axis=0), scans[:, known].std(axis=0)
    assert np.median(spread / np.maximum(0.005, 0.01 * mean)) == pytest.approx(1.0, abs=0.15)
    assert scans.min() >= 0.15


def test_cameras_show_a_moving_robot(lab: StillWorld) -> None:
    corner, turning = connected(lab, "camera"), connected(lab, "pan_tilt")
    model = lab.model
    arm = [index for index in range(model.nu) if model.actuator(index).name.startswith("ur5/")]
    for camera in (corner, turning):
        noise = difference(image(camera), image(camera))
        before = image(camera)
        now = lab.world.snapshot().ctrl[arm]
        lab.world.command("test", np.array(arm), now + np.array([1.2, 0.4, -0.6, 0, 0, 0]), ramp_s=1.0)
        lab.go_on(2.0)
        after = image(camera)
        assert difference(before, after) > noise + 20, "the image has not changed"
        camera.close()


def difference(one: Image, other: Image) -> int:
    """Number of pixels that changed by more than noise."""
    assert one.rgb is not None
    assert other.rgb is not None
    return int((np.abs(one.rgb.astype(int) - other.rgb.astype(int)).max(axis=2) > 25).sum())


def test_the_depth_camera_measures_the_person(world: StillWorld) -> None:
    depth = connected(world, "depth")

    def seen() -> bool:
        now = image(depth)
        assert now.depth_m is not None
        row_column, z = project(now, np.array(world.place("person")))
        height, width = now.depth_m.shape
        row, column = row_column
        if not (5 <= row < height - 5 and 5 <= column < width - 5 and 0.5 < z < 7):
            return False
        patch = now.depth_m[row - 2 : row + 3, column - 2 : column + 3]
        return bool(abs(np.median(patch) - z) < 0.3)

    until(world, seen)
    depth.close()


def project(image: Image, point: np.ndarray) -> tuple[tuple[int, int], float]:
    """Row and column of a point in an image, and its depth [m]."""
    pixels = image.depth_m if image.depth_m is not None else image.rgb
    assert pixels is not None
    height, width = pixels.shape[:2]
    x, y, z = image.rotation.T @ (point - image.position_m)
    focal = height / 2 / math.tan(image.fovy_rad / 2)
    return (round(height / 2 - focal * y / -z), round(width / 2 + focal * x / -z)), -z


def test_depth_equals_a_ray_and_is_infinite_out_of_range(world: StillWorld) -> None:
    entry = world.entry("depth")
    near = connected(world, changed(entry, options={"furthest_m": 2.0}))
    depth_m = image(near).depth_m
    assert depth_m is not None
    assert np.isinf(depth_m).any()
    assert depth_m[np.isfinite(depth_m)].max() < 2.1
    near.close()


def test_the_door_contact_follows_the_door_and_the_door_its_control(world: StillWorld) -> None:
    door, contact = connected(world, "door"), connected(world, "door_contact")
    assert contact.read("contact") == {"open": False}
    assert door.set("opening", 0.5) == pytest.approx(0.5)
    world.go_on(0.6)
    assert contact.read("contact") == {"open": True}
    assert 0.05 < door.read("settings")["opening"] < 0.45, "the door moves at limited speed"
    world.go_on(4.0)
    assert door.read("settings")["opening"] == pytest.approx(0.5, abs=0.05)
    door.set("opening", 0.0)
    world.go_on(6.0)
    assert contact.read("contact") == {"open": False}


def test_hold_stops_the_door(world: StillWorld) -> None:
    door = connected(world, "door")
    door.set("opening", 1.0)
    world.go_on(1.0)
    door.hold()  # type: ignore[attr-defined]
    held = door.read("settings")["opening"]
    world.go_on(5.0)
    assert door.read("settings")["opening"] == pytest.approx(held, abs=0.08)


def test_a_pan_tilt_camera_reports_its_pose(world: StillWorld) -> None:
    camera = connected(world, "pan_tilt")
    before = image(camera)
    camera.set("pan", 1.0)
    world.go_on(5.0)
    after = image(camera)
    assert camera.read("settings")["pan"] == pytest.approx(1.0, abs=0.03)
    cosine = float(before.rotation[:, 2] @ after.rotation[:, 2])
    assert 0.5 < math.acos(cosine) < 1.2
    assert difference(before, after) > 5000
    camera.close()


def test_the_lamp_changes_the_light_meter(world: StillWorld) -> None:
    lamp, meter = connected(world, "lamp"), connected(world, changed(world.entry("light"), options={"seed": 3}))
    lamp.set("level", 0.0)
    world.go_on(0.02)
    dark = meter.read("light")["light_lux"]
    lamp.set("level", 1.0)
    world.go_on(0.02)
    until(world, lambda: meter.read("light")["light_lux"] > dark + 100, step_s=0.02)


# ---------------------------------------------------------------- noise


def test_noise_is_reproducible_by_seed() -> None:
    errors = NoiseParameters(offset=2.0, jitter=0.5)
    readings = [[SensorNoise(errors, generator("one", seed)).read(20.0, 0.0) for _ in range(3)] for seed in (1, 1, 2)]
    assert readings[0] == readings[1] != readings[2]
    offsets = [np.mean([sensor.read(0.0, each) for each in range(200)]) for sensor in sensors_of(errors, 300)]
    assert np.std(offsets) == pytest.approx(2.0, rel=0.15)


def sensors_of(errors: NoiseParameters, count: int) -> list[SensorNoise]:
    return [SensorNoise(errors, generator("many", seed)) for seed in range(count)]


def test_readings_lag_behind_a_step() -> None:
    sensor = SensorNoise(NoiseParameters(lag_s=10.0), generator("slow", 0))
    assert sensor.read(0.0, 0.0) == 0
    assert sensor.read(1.0, 10.0) == pytest.approx(1 - math.exp(-1))
    assert sensor.read(1.0, 100.0) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("quantity", NOISE)
def test_readings_respect_minimum_and_resolution(quantity: str) -> None:
    errors = NOISE[quantity]
    for sensor in sensors_of(errors, 20):
        readings = sensor.read(0.3, 0.0)
        assert readings >= errors.least
        assert readings / errors.step == pytest.approx(round(readings / errors.step), abs=1e-3)


# ---------------------------------------------------------------- invalid configuration


def test_an_unknown_driver_is_rejected() -> None:
    with pytest.raises(SensorError, match=r"no sensor driver 'crystal_ball'; there are: .*mujoco"):
        load("crystal_ball")
    assert {"mujoco", "perception"} <= set(names())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "telescope"}, "no kind 'telescope'; it has: camera, .*thermostat"),
        ({"options": {"colour": "red"}}, "no option 'colour'; it has: .*joint"),
        ({"options": {"joint": 3}}, "option 'joint' .* is 3, of the wrong type"),
        ({"options": {"seed": True}}, "option 'seed' .* is True, of the wrong type"),
    ],
)
def test_an_invalid_entry_is_rejected(world: StillWorld, changes: dict[str, object], message: str) -> None:
    with pytest.raises(SensorError, match=message):
        world.driver(changed(world.entry("door_contact"), **changes))


def test_a_name_missing_in_the_model_is_rejected(world: StillWorld) -> None:
    driver = world.driver(changed(world.entry("door_contact"), options={"joint": "gate"}))
    with pytest.raises(SensorError, match=r"no joint 'gate'; it has: .*door"):
        driver.connect()


def test_an_oversized_image_is_rejected(world: StillWorld) -> None:
    with pytest.raises(SensorError, match="at most 1920 x 1080"):
        world.driver(changed(world.entry("camera"), options={"width": 100_000}))


def test_a_real_room_has_no_simulated_devices(world: StillWorld) -> None:
    with pytest.raises(SensorError, match="its room has no model"):
        simulated.create(world.entry("pir"), LAB, Surroundings(neighbours={}))


def test_a_missing_quantity_is_reported(world: StillWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(StillWorld, "quantities", {"temperature_c": 20.0})
    meter = connected(world, changed(world.entry("co2"), streams=(Stream(name="co2", rate_hz=1.0),)))
    with pytest.raises(SensorError, match="this room has no co2_ppm; it has: temperature_c"):
        meter.read("co2")
