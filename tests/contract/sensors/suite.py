"""Contract of every driver of a room device. A third party inherits the suite and supplies its two fixtures."""

import json
import math
import re
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from device_agent.ports.sensor import Camera, Image, Movable, RoomDriver, Scan, SensorError
from device_agent.protocol import FIELD_PATTERN, MAX_VALUES, Measurements, camera_frames, codec
from device_agent.protocol.camera_frames import CameraFrame
from device_agent.protocol.manifests.room import RoomDeviceManifest
from tests.harness.network.cameras.frames import frame_size

PNG = b"\x89PNG\r\n\x1a\n"


def all_calls(driver: RoomDriver, entry: RoomDeviceManifest) -> list[Callable[[], object]]:
    """Every call that needs a connection."""
    calls: list[Callable[[], object]] = [partial(driver.read, stream.name) for stream in entry.streams]
    calls += [partial(driver.capture, name) for name in entry.captures]
    calls += [partial(driver.set, control.name, control.lower) for control in entry.controls]
    if isinstance(driver, Camera):
        calls += [partial(driver.frame, camera.name) for camera in entry.cameras]
    return calls


class RoomDriverContract:
    """The suite. ``driver`` supplies an unconnected driver and closes it afterwards.

    Attributes:
        resolution: Largest difference between a requested and an applied value, for a device with few values.
    """

    resolution = 1e-6

    @pytest.fixture
    def entry(self) -> RoomDeviceManifest:
        raise NotImplementedError

    @pytest.fixture
    def driver(self, entry: RoomDeviceManifest) -> RoomDriver:
        raise NotImplementedError

    @pytest.fixture
    def connected(self, driver: RoomDriver) -> RoomDriver:
        driver.connect()
        return driver

    def test_nothing_works_before_connect(self, driver: RoomDriver, entry: RoomDeviceManifest) -> None:
        assert isinstance(driver, RoomDriver)
        assert isinstance(driver.simulated, bool)
        for call in all_calls(driver, entry):
            with pytest.raises(SensorError):
                call()

    def test_streams_return_finite_values_with_valid_names(
        self, connected: RoomDriver, entry: RoomDeviceManifest
    ) -> None:
        for stream in entry.streams:
            values = connected.read(stream.name)
            assert len(values) <= MAX_VALUES
            assert all(re.fullmatch(FIELD_PATTERN, name) for name in values)
            assert all(math.isfinite(value) for value in values.values())
            if values:
                codec.encode(Measurements(tick_ms=1, at_ms=1, sequence=1, values=dict(values)))

    def test_captures_have_their_media_type(self, connected: RoomDriver, entry: RoomDeviceManifest) -> None:
        for name in entry.captures:
            taken = connected.capture(name)
            assert taken.content
            match taken.media_type:
                case "image/png":
                    assert taken.content.startswith(PNG)
                case "application/json":
                    json.loads(taken.content)

    def test_cameras_return_frames_of_the_declared_kind_and_size(
        self, connected: RoomDriver, entry: RoomDeviceManifest
    ) -> None:
        if entry.cameras:
            assert isinstance(connected, Camera)
            for camera in entry.cameras:
                frame = connected.frame(camera.name)
                assert frame is not None
                assert frame.kind == camera.kind
                assert frame_size(frame) == (frame.width, frame.height)
                camera_frames.encode(CameraFrame(1, 1, frame.width, frame.height, frame.content, frame.kind))

    def test_controls_apply_the_returned_value(self, connected: RoomDriver, entry: RoomDeviceManifest) -> None:
        for control in entry.controls:
            middle = (control.lower + control.upper) / 2
            for value in (control.lower, control.upper, middle):
                assert math.isclose(connected.set(control.name, value), value, abs_tol=self.resolution)
        if isinstance(connected, Movable):
            connected.hold()

    def test_raw_arrays_are_consistent(self, connected: RoomDriver) -> None:
        raw = connected.raw()
        if raw is None:
            return
        assert np.allclose(raw.rotation @ raw.rotation.T, np.eye(3), atol=1e-6)
        assert np.isfinite(raw.position_m).all()
        if isinstance(raw, Scan):
            assert raw.range_m.shape == raw.angle_rad.shape
            met = raw.range_m[np.isfinite(raw.range_m)]
            assert ((met >= raw.nearest_m) & (met <= raw.furthest_m * 1.2)).all()
            assert not np.isnan(raw.range_m).any()
        else:
            assert isinstance(raw, Image)
            assert raw.rgb is not None or raw.depth_m is not None
            assert 0 < raw.fovy_rad < math.pi
            if raw.rgb is not None:
                assert raw.rgb.dtype == np.uint8
            if raw.depth_m is not None:
                assert (raw.depth_m > 0).all()

    def test_unknown_names_are_rejected_with_the_valid_ones(
        self, connected: RoomDriver, entry: RoomDeviceManifest
    ) -> None:
        calls: list[tuple[Callable[[], object], list[str]]] = [
            (partial(connected.read, "nonsense"), [stream.name for stream in entry.streams]),
            (partial(connected.set, "nonsense", 0.0), [control.name for control in entry.controls]),
            (partial(connected.capture, "nonsense"), list(entry.captures)),
        ]
        for call, valid in calls:
            with pytest.raises(SensorError, match="nonsense") as error:
                call()
            assert all(name in str(error.value) for name in valid)

    def test_connect_and_close_are_idempotent_and_repeatable(
        self, connected: RoomDriver, entry: RoomDeviceManifest
    ) -> None:
        connected.close()
        connected.connect()
        connected.connect()
        for stream in entry.streams:
            connected.read(stream.name)
        connected.close()
        connected.close()
        for call in all_calls(connected, entry):
            with pytest.raises(SensorError):
                call()
