"""Room devices: description, streams and cameras."""

import math
from unittest import mock

import pytest
from msgspec.structs import replace

from device_agent.ports.sensor import RoomDriver
from device_agent.protocol import CameraStream, Control, Description, camera_frames, topics
from device_agent.protocol.manifests.room import Watch
from device_agent.runtime.readings import ReadingCache
from device_agent.runtime.room.room_device import RoomDevice
from device_agent.runtime.telemetry import device_publisher, rate_meter
from tests.harness.agent.device_harness import eventually, wait_for_state
from tests.harness.agent.load import raise_level
from tests.unit.device_agent.runtime.room.conftest import MakeRoomDevice
from tests.unit.device_agent.runtime.room.room_device_fixture import (
    ENTRY,
    JPEG,
    FakeSensor,
    ReducibleSensor,
    RoomDeviceHarness,
    await_growth,
)


def test_description_lists_streams_and_actions(harness: RoomDeviceHarness) -> None:
    described: Description = eventually(lambda: harness.published(topics.DESC, Description))[-1]
    assert described.joints == ()
    assert described.limits == ()
    assert described.robot_type == described.kind == "window"
    assert described.streams == ENTRY.streams
    assert described.cameras == ENTRY.cameras
    assert described.captures == ("image",)
    assert described.position_m == (1.0, -2.0, 1.5)
    assert described.controls == (Control(name="opening", label="Opening", unit="m", lower=0.0, upper=0.5),)
    assert described.actions == ("gather", "shoot", "capture", "set_control")
    assert described.simulated


def test_streams_are_published_in_order_without_empty_readings_and_infinite_values(harness: RoomDeviceHarness) -> None:
    await_growth(harness.measured)
    published = harness.measured()
    assert [each.sequence for each in published] == list(range(1, len(published) + 1))
    assert [each.tick_ms for each in published] == sorted(each.tick_ms for each in published)
    assert all(set(each.values) == {"reads"} for each in published)
    eventually(lambda: harness.sensor.reads["rain"] > 1)
    assert harness.measured("rain") == []
    harness.sensor.values = {"hot": math.nan, "cold": -math.inf, "finite": True}
    eventually(lambda: any("finite" in each.values for each in harness.measured()))
    assert not any({"hot", "cold"} & set(each.values) for each in harness.measured())


def test_frames_have_a_header_and_are_not_stored(harness: RoomDeviceHarness) -> None:
    await_growth(harness.pictures)
    published = [camera_frames.decode(picture) for picture in harness.pictures()]
    assert [each.sequence for each in published] == list(range(1, len(published) + 1))
    assert all((each.width, each.height, each.content) == (4, 3, JPEG) for each in published)
    assert not any(topics.CAM in item.topic for item in harness.outbox._incoming)
    harness.sensor.picture = b""
    await_growth(harness.measured)
    count = len(harness.pictures())
    await_growth(harness.measured)
    assert len(harness.pictures()) <= count + 1, "one frame may have been in flight"


def test_frames_keep_their_kind_and_are_reduced_and_watched_like_pictures(make_room_device: MakeRoomDevice) -> None:
    sensor = FakeSensor()
    sensor.frame_kind, sensor.picture = "people", b'{"people":[]}'
    stream = CameraStream(name="garden", rate_hz=20.0, kind="people")
    watch = (Watch(source="garden", stuck_s=0.2),)
    harness = make_room_device(sensor=sensor, entry=replace(ENTRY, cameras=(stream,), watch=watch))
    described: Description = eventually(lambda: harness.published(topics.DESC, Description))[-1]
    assert described.cameras == (stream,)
    await_growth(harness.pictures)
    assert {camera_frames.decode(each).kind for each in harness.pictures()} == {"people"}
    wait_for_state(harness, lambda state: any(fault.code == "stuck.garden" for fault in state.faults))
    raise_level(harness.load, 1)
    assert harness.room_device.rate_hz("garden") == 5.0


def test_measurements_are_available_to_other_devices_and_repeated_stops_close_the_driver(
    harness: RoomDeviceHarness,
) -> None:
    readings = ReadingCache(space="s", agent="a", own=["arm"], named=[("arm", "air")])
    harness.device._readings = readings
    eventually(lambda: readings.latest("arm", "air"))
    harness.device.stop()
    harness.device.stop()
    assert harness.sensor.closed


def test_hold_and_cameras_are_optional() -> None:
    room_device = RoomDevice(mock.create_autospec(RoomDriver, instance=True, simulated=False), ENTRY, None)
    room_device.hold()
    assert room_device.cameras == ()
    assert not room_device.simulated


def test_an_overloaded_agent_reads_cameras_first_and_streams_last_less_often(make_room_device: MakeRoomDevice) -> None:
    sensor = ReducibleSensor()
    harness = make_room_device(sensor=sensor)
    device = harness.room_device
    assert (device.rate_hz("garden"), device.rate_hz("air")) == (20.0, 20.0)
    raise_level(harness.load, 1)
    assert (device.rate_hz("garden"), device.rate_hz("air")) == (5.0, 20.0)
    raise_level(harness.load, 2)
    eventually(lambda: sensor.share == 0.5)
    raise_level(harness.load, 3)
    assert device.rate_hz("air") == 10.0


def test_the_state_has_the_load_level_and_the_measured_rates(
    make_room_device: MakeRoomDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rate_meter, "WINDOW_S", 0.3)
    monkeypatch.setattr(device_publisher, "LOADED_STATE_PERIOD_S", 0.05)
    harness = make_room_device()
    await_growth(harness.measured)
    raise_level(harness.load, 1)
    state = wait_for_state(harness, lambda state: state.load == 1 and {"tele/air", "cam/garden"} <= set(state.rates_hz))
    assert state.rates_hz["tele/air"] > 0
