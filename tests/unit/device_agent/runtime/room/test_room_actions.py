"""Actions of room devices: collect, picture, capture, control."""

from pathlib import Path
from typing import Any

import pytest

from device_agent.protocol import (
    AckStatus,
    CancelAction,
    CaptureRaw,
    CollectData,
    MoveJoints,
    SetControl,
    TakePicture,
)
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.runtime.room.room_device import RoomDevice
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.unit.device_agent.runtime.room.room_device_fixture import RoomDeviceHarness, await_growth


def test_collecting_changes_the_rate_reports_progress_and_ends(harness: RoomDeviceHarness) -> None:
    before = harness.sensor.reads["rain"]
    command = harness.command(CollectData(streams=("air", "rain"), rate_hz=50.0, duration_s=1.5), epoch=harness.epoch())
    ack = harness.end(command)
    assert ack.status is AckStatus.DONE
    assert harness.sensor.reads["rain"] - before > 20, "ten times its own rate"
    assert 20 < ack.result["samples"]["air"] <= 80
    assert ack.result["samples"]["rain"] == 0, "the stream has no values"
    progress = [each.progress for each in harness.acks(command) if each.status is AckStatus.STARTED]
    assert any(share and 0 < share < 1 for share in progress)
    assert harness.device._driver.rate_hz("air") == 20.0  # type: ignore[union-attr]


def test_collecting_can_be_cancelled_and_excludes_other_actions(harness: RoomDeviceHarness) -> None:
    first = harness.command(CollectData(rate_hz=1.0, duration_s=3000.0), epoch=harness.epoch())
    eventually(lambda: any(ack.status is AckStatus.STARTED for ack in harness.acks(first)))
    second = harness.end(harness.command(CollectData(rate_hz=2.0, duration_s=1.0), epoch=harness.given))
    assert (second.status, second.reason and second.reason.code) == (AckStatus.FAILED, "busy")
    harness.command(CancelAction(action=first), epoch=harness.given)
    assert harness.end(first).status is AckStatus.CANCELLED
    await_growth(harness.measured)


def test_take_picture_returns_the_values(harness: RoomDeviceHarness) -> None:
    harness.sensor.values = {"temperature_c": 21.5}
    ack = harness.done(TakePicture(streams=("air",)))
    assert ack.status is AckStatus.DONE
    assert ack.result["values"]["air"]["temperature_c"] == 21.5
    assert set(harness.done(TakePicture()).result["values"]) == {"air", "rain"}


def test_a_capture_is_uploaded_and_named_in_the_result(harness: RoomDeviceHarness) -> None:
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


def test_a_control_is_set_within_its_limits_and_returns_the_applied_value(harness: RoomDeviceHarness) -> None:
    ack = harness.done(SetControl(control="opening", value=0.4))
    assert (ack.status, ack.result) == (AckStatus.DONE, {"applied": {"opening": 0.2}})
    for value, code in ((0.6, "out_of_range"), (-0.1, "out_of_range")):
        refused = harness.done(SetControl(control="opening", value=value))
        assert (refused.status, refused.reason and refused.reason.code) == (AckStatus.FAILED, code)
    assert harness.sensor.set_to == [0.4]


@pytest.mark.parametrize(
    ("request_", "code", "message"),
    [
        (TakePicture(streams=("wind",)), "unknown_stream", "there are air, rain"),
        (CollectData(streams=("wind",), rate_hz=1.0, duration_s=1.0), "unknown_stream", "there are air, rain"),
        (CaptureRaw(name="film"), "unknown_capture", "there are: image"),
        (SetControl(control="colour", value=1.0), "unknown_control", "there are: opening"),
        (MoveJoints(position_rad={"elbow": 1.0}), "cannot", "it has"),
    ],
)
def test_unknown_names_are_rejected_with_the_valid_ones(
    harness: RoomDeviceHarness, request_: Any, code: str, message: str
) -> None:
    ack = harness.done(request_)
    assert ack.status is AckStatus.FAILED
    assert ack.reason is not None
    assert ack.reason.code == code
    assert message in ack.reason.message


def test_a_robot_rejects_actions_of_room_devices(tmp_path: Path) -> None:
    harness = DeviceHarness(tmp_path)
    harness.device.start()
    try:
        ack = harness.end(harness.command(TakePicture(), epoch=1))
        assert (ack.status, ack.reason and ack.reason.code) == (AckStatus.FAILED, "cannot")
    finally:
        harness.stop()


def test_actions_without_streams_or_storage_are_rejected(tmp_path: Path) -> None:
    harness = RoomDeviceHarness(tmp_path, uploads=None, entry=RoomDeviceManifest(
        name="arm", kind="window", label="Window", driver="toy", captures=("image",)
    ))  # fmt: skip
    try:
        for request, code in ((TakePicture(), "no_streams"), (CaptureRaw(name="image"), "no_store")):
            ack = harness.done(request)
            assert (ack.status, ack.reason and ack.reason.code) == (AckStatus.FAILED, code)
    finally:
        harness.stop()


def test_errors_of_driver_and_storage_are_reported(harness: RoomDeviceHarness) -> None:
    harness.store.full = True
    ack = harness.done(CaptureRaw(name="image"))
    assert ack.reason is not None
    assert (ack.reason.code, ack.reason.message) == ("not_stored", "the store is full; delete something")
    instrument = harness.device._driver
    assert isinstance(instrument, RoomDevice)
    harness.sensor.broken = "it is wet"
    for call in (
        lambda: instrument.take_picture(()),
        lambda: instrument.capture_raw("image"),
        lambda: instrument.set("opening", 0.1),
    ):
        with pytest.raises(Exception, match="it is wet"):
            call()
