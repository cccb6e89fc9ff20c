"""Room devices: description, streams and cameras."""

import math
from pathlib import Path

import pytest

from device_agent.ports.sensor import Capture, SensorError
from device_agent.protocol import (
    Control,
    Description,
    camera_frames,
    topics,
)
from device_agent.runtime.readings import ReadingCache
from device_agent.runtime.room.room_device import RoomDevice
from tests.harness.agent.device_harness import eventually
from tests.unit.device_agent.runtime.room.room_device_fixture import (
    ENTRY,
    JPEG,
    FakeSensor,
    RoomDeviceHarness,
    await_growth,
)


def test_description_lists_streams_and_actions(harness: RoomDeviceHarness) -> None:
    harness.device.link_changed(True)
    described: Description = eventually(lambda: harness.heard(topics.DESC, Description))[-1]
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


def test_streams_are_published_in_order_and_empty_readings_are_not(harness: RoomDeviceHarness) -> None:
    await_growth(harness.measured)
    published = harness.measured()
    assert [each.sequence for each in published] == list(range(1, len(published) + 1))
    assert [each.tick_ms for each in published] == sorted(each.tick_ms for each in published)
    assert all(set(each.values) == {"reads"} for each in published)
    eventually(lambda: harness.sensor.reads["rain"] > 1)
    assert harness.measured("rain") == []


def test_values_that_are_not_finite_are_omitted(harness: RoomDeviceHarness) -> None:
    harness.sensor.values = {"hot": math.nan, "cold": -math.inf, "well": True}
    eventually(lambda: any("well" in each.values for each in harness.measured()))
    assert not any({"hot", "cold"} & set(each.values) for each in harness.measured())


def test_frames_have_a_header_and_are_not_stored(harness: RoomDeviceHarness) -> None:
    await_growth(harness.pictures)
    published = [camera_frames.decode(picture) for picture in harness.pictures()]
    assert [each.sequence for each in published] == list(range(1, len(published) + 1))
    assert all((each.width, each.height, each.jpeg) == (4, 3, JPEG) for each in published)
    assert not any(topics.CAM in item.topic for item in harness.outbox._incoming)


def test_a_camera_without_a_picture_publishes_no_frame(harness: RoomDeviceHarness) -> None:
    await_growth(harness.pictures)
    harness.sensor.picture = b""
    await_growth(harness.measured)
    filmed = len(harness.pictures())
    await_growth(harness.measured)
    assert len(harness.pictures()) <= filmed + 1, "one frame may have been in flight"


def test_a_control_value_must_be_finite() -> None:
    instrument = RoomDevice(FakeSensor(), ENTRY, None)
    for value in (math.nan, math.inf):
        with pytest.raises(Exception, match="must be a finite number"):
            instrument.set("opening", value)


def test_measurements_are_available_to_other_devices_of_the_agent(harness: RoomDeviceHarness) -> None:
    room = ReadingCache(space="s", agent="a", own=["arm"], named=[("arm", "air")])
    harness.device._readings = room
    eventually(lambda: room.latest("arm", "air"))


def test_the_driver_is_closed_once_on_repeated_stops(tmp_path: Path) -> None:
    harness = RoomDeviceHarness(tmp_path)
    harness.device.stop()
    harness.stop()
    assert harness.sensor.closed


class MinimalSensor:
    """A sensor without moving parts."""

    simulated = False

    def connect(self) -> None: ...

    def read(self, stream: str) -> dict[str, float | bool]:
        return {stream: 1.0}

    def capture(self, name: str) -> Capture:
        raise SensorError(name)

    def set(self, control: str, value: float) -> float:
        raise SensorError(f"{control} {value}")

    def raw(self) -> None: ...

    def close(self) -> None: ...


def test_hold_and_cameras_are_optional() -> None:
    instrument = RoomDevice(MinimalSensor(), ENTRY, None)
    instrument.hold()
    assert instrument.cameras == ()
    assert not instrument.simulated
