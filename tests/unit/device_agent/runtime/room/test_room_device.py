"""Room devices: streams, cameras, actions, Stop and faults."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent.config.interlock_rule import InterlockRule
from device_agent.ports.sensor import Capture, Frame, SensorError
from device_agent.ports.uploads import UploadError
from device_agent.protocol import (
    Ack,
    AckStatus,
    CancelAction,
    CaptureRaw,
    CollectData,
    Control,
    Description,
    Measurements,
    Mode,
    MoveJoints,
    ResetStop,
    RoomTask,
    SetControl,
    StopDevice,
    Stream,
    TakePicture,
    camera_frames,
    topics,
)
from device_agent.protocol.codec import MAX_BYTES
from device_agent.protocol.manifests.room import Control as RoomControl
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.runtime.readings import ReadingCache
from device_agent.runtime.room.room_device import RoomDevice
from tests.harness.agent.device_harness import DeviceHarness, eventually, shown

JPEG = b"\xff\xd8 a picture \xff\xd9"
ENTRY = RoomDeviceManifest(
    name="arm",  # the harness's device is called so
    kind="window",
    label="Window",
    driver="toy",
    streams=(Stream(name="air", rate_hz=20.0), Stream(name="rain", rate_hz=5.0)),
    cameras=(Stream(name="garden", rate_hz=20.0),),
    captures=("image",),
    controls=(RoomControl(name="opening", label="Opening", unit="m", lower=0.0, upper=0.5),),
    position_m=(1.0, -2.0, 1.5),
)


class FakeSensor:
    """Measures how often it was asked."""

    simulated = True

    def __init__(self) -> None:
        self.reads: dict[str, int] = {"air": 0, "rain": 0}
        self.broken = ""
        self.set_to: list[float] = []
        self.holds = 0
        self.closed = False
        self.picture = JPEG
        self.values: dict[str, float | bool] = {}

    def connect(self) -> None:
        self._check()

    def read(self, stream: str) -> dict[str, float | bool]:
        self._check()
        self.reads[stream] += 1
        return {"reads": float(self.reads[stream]), **self.values} if stream == "air" else {}

    def frame(self, _camera: str) -> Frame | None:
        self._check()
        return None if not self.picture else Frame(4, 3, self.picture, time.monotonic())

    def capture(self, _name: str) -> Capture:
        self._check()
        return Capture("image/png", b"PNG")

    def set(self, _control: str, value: float) -> float:
        self._check()
        self.set_to.append(value)
        return value / 2

    def hold(self) -> None:
        self._check()
        self.holds += 1

    def raw(self) -> None:
        return None

    def close(self) -> None:
        self.closed = True

    def _check(self) -> None:
        if self.broken:
            raise SensorError(self.broken)


class ToyStore:
    """Remembers what was stored."""

    def __init__(self) -> None:
        self.stored: list[dict[str, Any]] = []
        self.full = False

    def store(self, device: str, **more: Any) -> str:
        if self.full:
            raise UploadError("the store is full; delete something")
        self.stored.append({"device": device, **more})
        return "u1"


class RoomBench(DeviceHarness):
    def __init__(self, folder: Path, **more: Any) -> None:
        self.sensor, self.store = FakeSensor(), ToyStore()
        self.uploads = more.pop("uploads", self.store)
        instrument = RoomDevice(self.sensor, more.pop("entry", ENTRY), self.uploads)
        super().__init__(folder, driver=instrument, kind=ENTRY.robot_type(), **more)  # type: ignore[arg-type]
        self.device.start()

    def done(self, request: RoomTask, **more: Any) -> Ack:
        """What became of an action."""
        return self.end(self.command(request, epoch=self.epoch(), **more))

    def epoch(self) -> int:
        """A new one for each action, as the cloud gives it."""
        self.given = getattr(self, "given", 0) + 1
        return self.given

    def measured(self, stream: str = "air") -> list[Measurements]:
        return self.heard(topics.TELE, Measurements, stream)

    def pictures(self) -> list[bytes]:
        wanted = topics.device("s", "a", "arm", topics.CAM, "garden")
        return [payload for topic, payload in self.said if topic == wanted]


@pytest.fixture
def harness(tmp_path: Path) -> Iterator[RoomBench]:
    harness = RoomBench(tmp_path)
    yield harness
    harness.stop()


def grows(things: Callable[[], list[Any]], by: int = 3) -> None:
    before = len(things())
    eventually(lambda: len(things()) >= before + by)


def test_description_lists_streams_and_actions(harness: RoomBench) -> None:
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


def test_streams_are_published_in_order_and_empty_readings_are_not(harness: RoomBench) -> None:
    grows(harness.measured)
    told = harness.measured()
    assert [each.sequence for each in told] == list(range(1, len(told) + 1))
    assert [each.tick_ms for each in told] == sorted(each.tick_ms for each in told)
    assert all(set(each.values) == {"reads"} for each in told)
    eventually(lambda: harness.sensor.reads["rain"] > 1)
    assert harness.measured("rain") == []


def test_values_that_are_not_finite_are_omitted(harness: RoomBench) -> None:
    harness.sensor.values = {"hot": math.nan, "cold": -math.inf, "well": True}
    eventually(lambda: any("well" in each.values for each in harness.measured()))
    assert not any({"hot", "cold"} & set(each.values) for each in harness.measured())


def test_frames_have_a_header_and_are_not_stored(harness: RoomBench) -> None:
    grows(harness.pictures)
    told = [camera_frames.decode(picture) for picture in harness.pictures()]
    assert [each.sequence for each in told] == list(range(1, len(told) + 1))
    assert all((each.width, each.height, each.jpeg) == (4, 3, JPEG) for each in told)
    assert not any(topics.CAM in item.topic for item in harness.outbox._incoming)


def test_a_camera_without_a_picture_publishes_no_frame(harness: RoomBench) -> None:
    grows(harness.pictures)
    harness.sensor.picture = b""
    grows(harness.measured)
    filmed = len(harness.pictures())
    grows(harness.measured)
    assert len(harness.pictures()) <= filmed + 1, "one may have been on its way"


def test_a_picture_that_is_too_large_is_a_fault_with_advice(harness: RoomBench) -> None:
    harness.device.link_changed(True)
    harness.sensor.picture = bytes(MAX_BYTES)
    state = shown(harness, lambda state: state.faults)
    assert "smaller pictures" in state.faults[0].message


def test_collecting_changes_the_rate_reports_progress_and_ends(harness: RoomBench) -> None:
    before = harness.sensor.reads["rain"]
    command = harness.command(CollectData(streams=("air", "rain"), rate_hz=50.0, duration_s=1.5), epoch=harness.epoch())
    ack = harness.end(command)
    assert ack.status is AckStatus.DONE
    assert harness.sensor.reads["rain"] - before > 20, "ten times its own rate"
    assert 20 < ack.result["samples"]["air"] <= 80
    assert ack.result["samples"]["rain"] == 0, "it had nothing to say"
    progress = [each.progress for each in harness.acks(command) if each.status is AckStatus.STARTED]
    assert any(share and 0 < share < 1 for share in progress)
    assert harness.device._driver.rate_hz("air") == 20.0  # type: ignore[union-attr]


def test_collecting_can_be_cancelled_and_excludes_other_actions(harness: RoomBench) -> None:
    first = harness.command(CollectData(rate_hz=1.0, duration_s=3000.0), epoch=harness.epoch())
    eventually(lambda: any(ack.status is AckStatus.STARTED for ack in harness.acks(first)))
    second = harness.end(harness.command(CollectData(rate_hz=2.0, duration_s=1.0), epoch=harness.given))
    assert (second.status, second.reason and second.reason.code) == (AckStatus.FAILED, "busy")
    harness.command(CancelAction(action=first), epoch=harness.given)
    assert harness.end(first).status is AckStatus.CANCELLED
    grows(harness.measured)


def test_take_picture_returns_the_values(harness: RoomBench) -> None:
    harness.sensor.values = {"temperature_c": 21.5}
    ack = harness.done(TakePicture(streams=("air",)))
    assert ack.status is AckStatus.DONE
    assert ack.result["values"]["air"]["temperature_c"] == 21.5
    assert set(harness.done(TakePicture()).result["values"]) == {"air", "rain"}


def test_a_capture_is_uploaded_and_named_in_the_result(harness: RoomBench) -> None:
    ack = harness.done(CaptureRaw(name="image"))
    assert ack.result == {"upload": "u1", "media_type": "image/png", "length": 3}
    stored = harness.store.stored[0]
    assert {key: stored[key] for key in ("device", "stream", "media_type", "content")} == {
        "device": "arm",
        "stream": "image",
        "media_type": "image/png",
        "content": b"PNG",
    }
    assert stored["name"].startswith("arm-image-")
    assert stored["name"].endswith(".png")


def test_a_control_is_set_within_its_limits_and_returns_the_applied_value(harness: RoomBench) -> None:
    ack = harness.done(SetControl(control="opening", value=0.4))
    assert (ack.status, ack.result) == (AckStatus.DONE, {"applied": {"opening": 0.2}})
    for value, code in ((0.6, "out_of_range"), (-0.1, "out_of_range")):
        refused = harness.done(SetControl(control="opening", value=value))
        assert (refused.status, refused.reason and refused.reason.code) == (AckStatus.FAILED, code)
    assert harness.sensor.set_to == [0.4]


@pytest.mark.parametrize(
    ("request_", "code", "said"),
    [
        (TakePicture(streams=("wind",)), "unknown_stream", "there are air, rain"),
        (CollectData(streams=("wind",), rate_hz=1.0, duration_s=1.0), "unknown_stream", "there are air, rain"),
        (CaptureRaw(name="film"), "unknown_capture", "there are: image"),
        (SetControl(control="colour", value=1.0), "unknown_control", "there are: opening"),
        (MoveJoints(position_rad={"elbow": 1.0}), "cannot", "it has"),
    ],
)
def test_unknown_names_are_rejected_with_the_valid_ones(
    harness: RoomBench, request_: Any, code: str, said: str
) -> None:
    ack = harness.done(request_)
    assert ack.status is AckStatus.FAILED
    assert ack.reason is not None
    assert ack.reason.code == code
    assert said in ack.reason.message


def test_a_control_value_must_be_finite() -> None:
    instrument = RoomDevice(FakeSensor(), ENTRY, None)
    for value in (math.nan, math.inf):
        with pytest.raises(Exception, match="must be a finite number"):
            instrument.set("opening", value)


def test_a_robot_rejects_actions_of_room_devices(tmp_path: Path) -> None:
    harness = DeviceHarness(tmp_path)
    harness.device.start()
    try:
        ack = harness.end(harness.command(TakePicture(), epoch=1))
        assert (ack.status, ack.reason and ack.reason.code) == (AckStatus.FAILED, "cannot")
    finally:
        harness.stop()


def test_actions_without_streams_or_storage_are_rejected(tmp_path: Path) -> None:
    harness = RoomBench(tmp_path, uploads=None, entry=RoomDeviceManifest(
        name="arm", kind="window", label="Window", driver="toy", captures=("image",)
    ))  # fmt: skip
    try:
        for request, code in ((TakePicture(), "no_streams"), (CaptureRaw(name="image"), "no_store")):
            ack = harness.done(request)
            assert (ack.status, ack.reason and ack.reason.code) == (AckStatus.FAILED, code)
    finally:
        harness.stop()


def test_errors_of_driver_and_storage_are_reported(harness: RoomBench) -> None:
    harness.store.full = True
    ack = harness.done(CaptureRaw(name="image"))
    assert ack.reason is not None
    assert (ack.reason.code, ack.reason.message) == ("not_stored", "the store is full; delete something")
    instrument = harness.device._driver
    assert isinstance(instrument, RoomDevice)
    harness.sensor.broken = "it is wet"
    for deed in (
        lambda: instrument.take_picture(()),
        lambda: instrument.capture_raw("image"),
        lambda: instrument.set("opening", 0.1),
    ):
        with pytest.raises(Exception, match="it is wet"):
            deed()


def test_stop_holds_until_reset_while_streams_continue(harness: RoomBench) -> None:
    gathering = harness.command(CollectData(rate_hz=20.0, duration_s=3000.0), epoch=harness.epoch())
    eventually(lambda: any(ack.status is AckStatus.STARTED for ack in harness.acks(gathering)))
    harness.command(StopDevice(), epoch=0)
    assert harness.end(gathering).status is AckStatus.FAILED
    eventually(lambda: harness.sensor.holds == 1)
    refused = harness.done(SetControl(control="opening", value=0.1))
    assert (refused.status, refused.reason and refused.reason.code) == (AckStatus.FAILED, "stopped")
    grows(harness.measured)
    assert harness.sensor.holds == 1, "once is enough"
    assert harness.end(harness.command(ResetStop(), epoch=harness.epoch())).status is AckStatus.DONE
    assert harness.done(SetControl(control="opening", value=0.1)).status is AckStatus.DONE


def test_a_sensor_error_is_a_fault_until_the_sensor_responds(harness: RoomBench) -> None:
    harness.device.link_changed(True)
    grows(harness.measured)
    harness.sensor.broken = "no answer on the bus; is it plugged in?"
    state = shown(harness, lambda state: state.faults)
    assert state.mode is Mode.FAULT
    assert state.faults[0].message == harness.sensor.broken
    refused = harness.done(TakePicture())
    assert (refused.status, refused.reason and refused.reason.code) == (AckStatus.FAILED, "fault")
    harness.sensor.broken = ""
    shown(harness, lambda state: not state.faults)
    grows(harness.measured)


def test_a_missing_sensor_at_start_is_a_fault(tmp_path: Path) -> None:
    started = threading.Event()
    original = FakeSensor.connect

    def absent(self: FakeSensor) -> None:
        if not started.is_set():
            raise SensorError("not connected")
        original(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FakeSensor, "connect", absent)
        harness = RoomBench(tmp_path)
        try:
            harness.device.link_changed(True)
            assert shown(harness, lambda state: state.faults).faults[0].message == "not connected"
            started.set()
            grows(harness.measured)
        finally:
            harness.stop()


def test_an_unexpected_driver_error_is_a_fault_and_the_loop_continues(harness: RoomBench) -> None:
    harness.device.link_changed(True)

    def odd(_stream: str) -> dict[str, float]:
        raise ZeroDivisionError

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(harness.sensor, "read", odd)
        assert "internal error" in shown(harness, lambda state: state.faults).faults[0].message
    shown(harness, lambda state: not state.faults)
    grows(harness.measured)


def test_an_interlock_holds_a_room_device(tmp_path: Path) -> None:
    rule = InterlockRule(device="other-zone", stream="presence", field="near", equals=1.0, stale_s=5.0)
    harness = RoomBench(tmp_path, interlocks=(rule,))
    try:
        refused = harness.done(SetControl(control="opening", value=0.1))
        assert (refused.status, refused.reason and refused.reason.code) == (AckStatus.FAILED, "interlock")
        assert harness.sensor.holds == 1
    finally:
        harness.stop()


def test_measurements_are_available_to_other_devices_of_the_agent(harness: RoomBench) -> None:
    room = ReadingCache(space="s", agent="a", own=["arm"], named=[("arm", "air")])
    harness.device._readings = room
    eventually(lambda: room.latest("arm", "air"))


def test_the_driver_is_closed_once_on_repeated_stops(tmp_path: Path) -> None:
    harness = RoomBench(tmp_path)
    harness.device.stop()
    harness.stop()
    assert harness.sensor.closed


class ToyThermometer:
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
    instrument = RoomDevice(ToyThermometer(), ENTRY, None)
    instrument.hold()
    assert instrument.cameras == ()
    assert not instrument.simulated
