"""Sensors with ROS fulfil the contract of room drivers, and report what their messages contain."""

import json
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg

from device_agent import sensors
from device_agent.middleware.ros import images, scans
from device_agent.ports.sensor import Camera, Image, RoomDriver, Scan, SensorError, Surroundings
from device_agent.protocol.description import CameraStream, Stream
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.ros import base
from tests.contract.sensors.suite import RoomDriverContract
from tests.harness.network.cameras import frames
from tests.harness.network.cameras.frames import depths_mm
from tests.harness.robots.ros import sensors as peers
from tests.harness.robots.ros.ros_system import ros_system
from tests.harness.robots.ros.sensors import RosbridgeSensors, as_json, rospy_sensors

_WAIT_S = 60.0


def entry_of(kind: str, **options: object) -> RoomDeviceManifest:
    kinds = {"depth_camera": ("colour", "depth"), "lidar": ("scan",), "point_cloud": ()}.get(kind, ("colour",))
    cameras = tuple(CameraStream(name=each, rate_hz=5.0, kind=each) for each in kinds)
    streams = () if "camera" in kind else (Stream(name="range", rate_hz=5.0),)
    captures = {"lidar": "scan", "point_cloud": "cloud", "depth_camera": "depth"}
    return RoomDeviceManifest(
        name="sensor", kind=kind, label="Sensor", driver="ros", streams=streams, cameras=cameras,
        captures=(captures.get(kind, "image"),), position_m=(1.0, 2.0, 0.5),
        options={"topic": peers.TOPICS[kind], **options},
    )  # fmt: skip


def create(kind: str, **options: object) -> RoomDriver:
    return sensors.load("ros")(entry_of(kind, **options), Path(), Surroundings(neighbours={}))


def until(condition: Callable[[], object]) -> None:
    end_s = time.monotonic() + _WAIT_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.005)


@pytest.fixture(scope="module")
def rosbridge() -> Iterator[RosbridgeSensors]:
    peer = RosbridgeSensors()
    yield peer
    peer.close()


@pytest.fixture(scope="module")
def rospy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, object]]:
    folder = tmp_path_factory.mktemp("ros")
    with ros_system(folder) as system, rospy_sensors(system, folder) as options:
        yield options


@pytest.mark.parametrize("kind", peers.TOPICS)
class TestRosbridge(RoomDriverContract):
    @pytest.fixture
    def connection(self, rosbridge: RosbridgeSensors) -> dict[str, object]:
        return rosbridge.options

    @pytest.fixture
    def entry(self, kind: str, connection: dict[str, object]) -> RoomDeviceManifest:
        return entry_of(kind, **connection)

    @pytest.fixture
    def driver(self, entry: RoomDeviceManifest) -> Iterator[RoomDriver]:
        driver = sensors.load("ros")(entry, Path(), Surroundings(neighbours={}))
        yield driver
        driver.close()


@pytest.mark.long
class TestRospy(TestRosbridge):
    @pytest.fixture
    def connection(self, rospy: dict[str, object]) -> dict[str, object]:
        return rospy


# ------------------------------------------------------------ contents


@pytest.fixture(params=["rosbridge", "rosbridge2", "rospy"])
def options(request: pytest.FixtureRequest) -> Iterator[dict[str, object]]:
    if request.param == "rospy":
        yield request.getfixturevalue("rospy")
        return
    peer = RosbridgeSensors(ros := 1 if request.param == "rosbridge" else 2)
    yield {**peer.options, "ros": ros}
    peer.close()


def test_scans_pictures_and_clouds_have_the_values_of_their_messages(options: dict[str, object]) -> None:
    drivers = {kind: create(kind, **options) for kind in peers.TOPICS}
    for driver in drivers.values():
        driver.connect()
    scan = drivers["lidar"].raw()
    assert isinstance(scan, Scan)
    assert scan.range_m[:4].tolist() == [math.inf] * 4, "none, not a number, too near, too far"
    assert scan.range_m[4:] == pytest.approx(peers.RANGES_M[4:], abs=1e-6)
    assert scan.angle_rad[[0, 90]] == pytest.approx([-math.pi, -math.pi / 2])
    assert drivers["lidar"].read("range")["range_m.1"] == pytest.approx(1.41)
    picture, depth = drivers["camera"].raw(), drivers["depth_camera"].raw()
    assert isinstance(picture, Image)
    assert picture.rgb is not None
    assert np.array_equal(picture.rgb, peers.COLOURS)
    assert isinstance(depth, Image)
    assert depth.depth_m is not None
    assert depth.depth_m[0, :3].tolist() == pytest.approx([math.inf, 0.001, 0.002])
    for name, kind, expected in (("depth_camera", "depth", peers.DEPTHS_MM), ("lidar", "scan", None)):
        driver = drivers[name]
        assert isinstance(driver, Camera)
        frame = driver.frame(kind)
        assert frame is not None
        if expected is not None:
            assert np.array_equal(depths_mm(frame.content), expected)
            continue
        streamed = frames.scan(frame.content)
        assert streamed.range_m[:4] == (None,) * 4
        assert streamed.range_m[4:] == pytest.approx(peers.RANGES_M[4:], abs=1e-4)
        assert streamed.position_m == (1.0, 2.0, 0.5)
    content = json.loads(drivers["point_cloud"].capture("cloud").content)
    assert len(content["points_m"]) == 5000 / 3 // 1 + 1
    assert content["points_m"][0] == pytest.approx(peers.POINTS[0] + [1.0, 2.0, 0.5], abs=1e-3)
    assert drivers["point_cloud"].read("range")["points"] == len(content["points_m"])
    jpeg = drivers["compressed_camera"].capture("image")
    assert jpeg.media_type == "image/jpeg"
    assert simplejpeg.decode_jpeg(jpeg.content).shape == (48, 64, 3)
    for driver in drivers.values():
        driver.close()


def test_a_mounted_lidar_looks_where_its_options_say(rosbridge: RosbridgeSensors) -> None:
    driver = create("lidar", **rosbridge.options, rotation_rad=[0.0, 0.0, math.pi / 2])
    driver.connect()
    scan = driver.raw()
    driver.close()
    assert isinstance(scan, Scan)
    assert scan.position_m.tolist() == [1.0, 2.0, 0.5]
    assert scan.rotation[:, 0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-12), "its x axis is the room's y axis"


@pytest.fixture
def peer() -> Iterator[RosbridgeSensors]:
    peer = RosbridgeSensors()
    yield peer
    peer.close()


def test_a_silent_or_lost_sensor_is_reported_and_returns(
    peer: RosbridgeSensors, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(base, "SILENT_S", 0.3)
    monkeypatch.setattr(base, "_START_S", 0.3)
    driver = create("lidar", **peer.options)
    driver.connect()
    peer.change("/scan")
    with pytest.raises(SensorError, match="no new message on /scan; is it running"):
        until(lambda: driver.raw() is None)
    peer.stop()
    with pytest.raises(SensorError, match="is lost"):
        until(lambda: _lost(driver))
    with pytest.raises(SensorError, match="is rosbridge running"):
        driver.connect()
    peer.restart()
    with pytest.raises(SensorError, match="no message on /scan"):
        driver.connect()
    peer.messages["/scan"] = as_json(peers.MESSAGES["/scan"][1])
    driver.connect()
    assert driver.raw() is not None
    driver.close()


def _lost(driver: RoomDriver) -> bool:
    try:
        driver.raw()
    except SensorError as error:
        if "is lost" in str(error):
            raise
    return False


@pytest.mark.parametrize(
    ("kind", "fields", "reason"),
    [
        ("lidar", {"ranges": []}, "no ranges or invalid limits"),
        ("lidar", {"range_max": 0.05}, "no ranges or invalid limits"),
        ("lidar", {"angle_min": math.nan}, "Expected `float`, got `null`"),
        ("camera", {"encoding": "yuv422"}, "has the encoding 'yuv422'; use rgb8, bgr8, mono8"),
        ("camera", {"height": 49}, "a picture of 64 x 49 has 9216 bytes"),
        ("camera", {"step": 10}, "a picture of 64 x 48 has 9216 bytes"),
        ("camera", {"data": "?"}, "data"),
        ("compressed_camera", {"data": "AAAA"}, "JPEG"),
        ("depth_camera", {"encoding": "rgb8"}, "has the encoding 'rgb8'; use 16UC1, 32FC1"),
        ("point_cloud", {"fields": []}, "has no field 'x' of type float32"),
        ("point_cloud", {"row_step": 10}, "a PointCloud2 of 5001 x 1 points has"),
        ("point_cloud", {"point_step": 10}, "a PointCloud2 of 5001 x 1 points has"),
        ("point_cloud", {"height": 2}, "a PointCloud2 of 5001 x 2 points has"),
    ],
)
def test_invalid_messages_are_rejected_with_a_reason(
    peer: RosbridgeSensors, monkeypatch: pytest.MonkeyPatch, kind: str, fields: dict[str, Any], reason: str
) -> None:
    monkeypatch.setattr(base, "_START_S", 0.2)
    peer.change(peers.TOPICS[kind], **fields)
    driver = create(kind, **peer.options)
    with pytest.raises(SensorError, match=reason):
        driver.connect()
    driver.close()


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("lidar", {"topic": ""}, "topic"),
        ("lidar", {"beams": 3}, "unknown field `beams`; valid options: .*rotation_rad"),
        ("lidar", {"connection": "rospy", "ros": 2}, 'use "rosbridge" with ROS 2'),
        ("lidar", {"certificate_authority": "ca.pem"}, "needs an address with wss://"),
        ("camera", {"fovy_rad": 4.0}, "fovy_rad"),
    ],
)
def test_wrong_options_are_rejected(kind: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(SensorError, match=message):
        create(kind, **options)


def test_an_unknown_kind_is_rejected_with_the_valid_ones() -> None:
    entry = RoomDeviceManifest(name="x", kind="sonar", label="Sonar", driver="ros")
    with pytest.raises(SensorError, match="has no kind 'sonar'; it has: camera, compressed_camera"):
        sensors.load("ros")(entry, Path(), Surroundings(neighbours={}))


# ------------------------------------------------------------ pictures and bounds


def raw(pixels: Any, encoding: str, **changes: Any) -> images.RawImage:
    return images.RawImage(**{**peers.image(pixels, encoding, padding=3), **changes})


def test_each_encoding_has_its_colours_also_with_padded_rows() -> None:
    assert np.array_equal(images.colours(raw(peers.COLOURS, "rgb8")), peers.COLOURS)
    assert np.array_equal(images.colours(raw(peers.COLOURS, "bgr8")), peers.COLOURS[:, :, ::-1])
    grey = images.colours(raw(peers.COLOURS[:, :, 0], "mono8"))
    assert np.array_equal(grey, np.repeat(peers.COLOURS[:, :, :1], 3, axis=2))
    big = images.depths(raw(peers.DEPTHS_MM.astype(">u2"), "16UC1", is_bigendian=1))
    assert big[0, 5] == pytest.approx(0.005)
    metres = np.array([[1.5, math.nan, -1.0]], np.float32)
    assert images.depths(raw(metres, "32FC1")).tolist() == [[1.5, math.inf, math.inf]]


def test_a_displayed_depth_is_white_near_and_black_without_a_measurement() -> None:
    grey = images.displayed(np.array([[0.01, 4.0, 20.0, math.inf]], np.float32))[0, :, 0]
    assert grey.tolist() == [254, 127, 0, 0]


def test_large_pictures_are_reduced_until_they_fit() -> None:
    noise = np.random.default_rng(3).integers(0, 256, (1080, 1920, 3), np.uint8)
    width, height, content = images.to_jpeg(noise)
    assert width <= images.MAX_WIDTH
    assert len(content) <= images.MAX_JPEG
    assert simplejpeg.decode_jpeg(content).shape == (height, width, 3)
    assert abs(width / height - 1920 / 1080) < 0.02


def test_large_jpegs_of_a_camera_are_reduced(peer: RosbridgeSensors) -> None:
    noise = np.random.default_rng(3).integers(0, 256, (720, 1280, 3), np.uint8)
    content = simplejpeg.encode_jpeg(noise, quality=95)
    assert len(content) > images.MAX_JPEG
    peer.change("/camera/compressed", **as_json({"data": content}))
    driver = create("compressed_camera", **peer.options)
    driver.connect()
    assert isinstance(driver, Camera)
    frame = driver.frame("colour")
    driver.close()
    assert frame is not None
    assert len(frame.content) <= images.MAX_JPEG


def test_long_scans_are_reduced_evenly() -> None:
    scan = scans.LaserScan(0.0, 0.001, 0.1, 10.0, tuple(1.0 + index / 5000 for index in range(5000)))
    angles_rad, ranges_m = scans.beams(scan)
    assert len(ranges_m) == 1250
    assert angles_rad[1] == pytest.approx(0.004)
    assert ranges_m[1] == pytest.approx(1.0008)
