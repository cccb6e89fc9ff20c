"""Depth images and scans for viewers: exact values, and sizes below the limit of a message."""

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from device_agent import sensors
from device_agent.ports.sensor import Image, Scan, SensorError, Surroundings
from device_agent.protocol import CameraStream
from device_agent.protocol.camera_frames import MAX_CONTENT_BYTES
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.protocol.telemetry import MAX_BEAMS
from device_agent.sensors.frames import check_kinds, depth_capture, depth_frame
from tests.harness.network.cameras.frames import depths_mm, scan

RANDOM = np.random.default_rng(5)


def image(depth_m: Any) -> Image:
    return Image(taken_s=1.5, position_m=np.zeros(3), rotation=np.eye(3), fovy_rad=1.0, depth_m=depth_m)


def noisy(width: int, height: int, distance_m: float) -> Any:
    """A wall at a distance, with the noise of structured light."""
    deviation_m = 0.0012 + 0.0019 * (distance_m - 0.4) ** 2
    return (distance_m + RANDOM.normal(0.0, deviation_m, (height, width))).astype(np.float32)


def test_a_depth_frame_is_lossless_and_equals_the_capture() -> None:
    depth_m = np.array([[0.0004, 0.5, 1.2346], [65.535, 100.0, np.inf]], dtype=np.float32)
    frame = depth_frame(image(depth_m))
    assert depths_mm(frame.content).tolist() == [[0, 500, 1235], [65535, 65535, 0]]
    assert frame.content == depth_capture(depth_m).content
    assert (frame.width, frame.height, frame.kind, frame.taken_s) == (3, 2, "depth", 1.5)
    ramp = np.arange(65_536, dtype=np.uint16).reshape(256, 256)
    assert np.array_equal(depths_mm(depth_capture((ramp / 1000).astype(np.float32)).content), ramp)


@pytest.mark.parametrize("distance_m", [0.8, 2.0, 4.0, 8.0])
def test_a_noisy_depth_image_of_320_x_240_fits_into_a_message(distance_m: float) -> None:
    depth_m = noisy(320, 240, distance_m)
    frame = depth_frame(image(depth_m))
    assert (frame.width, frame.height) == (320, 240)
    assert len(frame.content) <= MAX_CONTENT_BYTES
    assert np.abs(depths_mm(frame.content) - depth_m * 1000).max() < 0.51


def test_an_image_that_is_too_large_is_halved_and_keeps_exact_pixels() -> None:
    depth_m = noisy(640, 480, 3.0)
    frame = depth_frame(image(depth_m))
    assert (frame.width, frame.height) == (320, 240)
    assert len(frame.content) <= MAX_CONTENT_BYTES
    assert np.abs(depths_mm(frame.content) - depth_m[::2, ::2] * 1000).max() < 0.51
    assert depths_mm(depth_capture(depth_m).content).shape == (480, 640), "captures are not reduced"
    chaos = RANDOM.uniform(0, 65, (1080, 1920)).astype(np.float32)
    frame = depth_frame(image(chaos))
    assert (frame.width, frame.height) == (240, 135)
    assert len(frame.content) <= MAX_CONTENT_BYTES


def test_a_picture_without_depths_is_no_depth_frame() -> None:
    with pytest.raises(SensorError, match="no depth"):
        depth_frame(image(None))


def beams(count: int) -> Scan:
    range_m = RANDOM.uniform(0.2, 12.0, count)
    range_m[::7] = np.inf
    return Scan(
        taken_s=2.5, position_m=np.array([1.0, 2.0, 0.3]), rotation=np.eye(3), angle_rad=np.linspace(-3.1, 3.1, count),
        range_m=range_m, nearest_m=0.15, furthest_m=12.0,
    )  # fmt: skip


def test_a_scan_frame_equals_the_capture_without_its_time() -> None:
    measured = beams(360)
    frame, captured = measured.frame(), json.loads(measured.capture().content)
    del captured["at_ms"]
    assert json.loads(frame.content) == captured
    assert scan(frame.content).range_m[0] is None
    assert scan(frame.content).range_m[1] == pytest.approx(measured.range_m[1], abs=1e-4)
    assert (frame.width, frame.height, frame.kind, frame.taken_s) == (360, 1, "scan", 2.5)
    assert frame.content == measured.frame().content, "a lidar that repeats its scan is found to be stuck"


def test_a_scan_with_many_beams_is_thinned_evenly() -> None:
    measured = beams(3 * MAX_BEAMS)
    frame = measured.frame()
    assert frame.width == MAX_BEAMS
    assert len(frame.content) <= MAX_CONTENT_BYTES / 2
    assert scan(frame.content).angle_rad == pytest.approx(measured.angle_rad[::3], abs=1e-6)
    assert len(json.loads(measured.capture().content)["range_m"]) == 3 * MAX_BEAMS, "captures are not reduced"


def entry(kind: str, driver: str, frames: str, **options: object) -> RoomDeviceManifest:
    return RoomDeviceManifest(
        name="eye", kind=kind, label="Eye", driver=driver, options=dict(options),
        cameras=(CameraStream(name="view", rate_hz=5.0, kind=frames),),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("device", "possible"),
    [
        (entry("lidar", "ros", "depth", topic="/scan"), "a lidar with driver 'ros' has: scan"),
        (entry("depth_camera", "ros", "people", topic="/depth"), "has: colour, depth"),
        (entry("point_cloud", "ros", "scan", topic="/cloud"), "has: no cameras"),
        (entry("camera", "mjpeg", "depth", url="http://127.0.0.1/"), "has: colour"),
    ],
)
def test_kinds_that_a_driver_cannot_supply_are_rejected(device: RoomDeviceManifest, possible: str) -> None:
    with pytest.raises(SensorError, match=f"camera 'view' of 'eye' has the kind .*{possible}"):
        sensors.load(device.driver)(device, Path(), Surroundings(neighbours={}))
    check_kinds(msgspec.structs.replace(device, cameras=()), ())
