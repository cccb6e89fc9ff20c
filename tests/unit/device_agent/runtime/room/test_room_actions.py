"""Actions of room devices: collect, picture, capture, control."""

import math
import re

import pytest

from device_agent.protocol import (
    AckStatus,
    CancelAction,
    CaptureRaw,
    CollectData,
    MoveJoints,
    SetControl,
    TakePicture,
    Task,
)
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.runtime.errors import Refused
from tests.harness.agent.controller_fixture import refuses
from tests.harness.agent.device_harness import eventually
from tests.unit.device_agent.runtime.conftest import MakeDevice
from tests.unit.device_agent.runtime.room.conftest import MakeRoomDevice
from tests.unit.device_agent.runtime.room.room_device_fixture import RoomDeviceHarness, await_growth


@pytest.mark.slow
def test_collecting_reports_progress_and_ends_with_the_former_rate(harness: RoomDeviceHarness) -> None:
    before = harness.sensor.reads["air"]
    ack = harness.done(CollectData(streams=("air", "rain"), rate_hz=50.0, duration_s=1.5))
    assert 0 < ack.result["samples"]["air"] <= min(80, harness.sensor.reads["air"] - before)
    assert ack.result["samples"]["rain"] == 0, "the stream has no values"
    progress = [each.progress for each in harness.acks(ack.id) if each.status is AckStatus.STARTED]
    assert any(share and 0 < share < 1 for share in progress)
    assert harness.room_device.rate_hz("air") == 20.0


def test_collecting_reads_all_streams_at_its_own_rate(harness: RoomDeviceHarness) -> None:
    action = harness.running(CollectData(streams=("air", "rain"), rate_hz=50.0, duration_s=3000.0))
    eventually(lambda: harness.room_device.rate_hz("air") == 50.0)
    before = dict(harness.sensor.reads)
    eventually(lambda: harness.sensor.reads["air"] - before["air"] >= 40)
    assert harness.sensor.reads["rain"] - before["rain"] > 20, "at its own rate it is read once for four of the others"
    harness.command(CancelAction(action=action), epoch=1)
    harness.end(action)


def test_collecting_can_be_cancelled_and_excludes_other_actions(harness: RoomDeviceHarness) -> None:
    first = harness.running(CollectData(rate_hz=1.0, duration_s=3000.0))
    assert harness.failed(CollectData(rate_hz=2.0, duration_s=1.0), epoch=1).code == "busy"
    harness.command(CancelAction(action=first), epoch=1)
    assert harness.end(first).status is AckStatus.CANCELLED
    await_growth(harness.measured)


def test_take_picture_returns_the_values(harness: RoomDeviceHarness) -> None:
    harness.sensor.values = {"temperature_c": 21.5}
    assert harness.done(TakePicture(streams=("air",))).result["values"]["air"]["temperature_c"] == 21.5
    assert set(harness.done(TakePicture()).result["values"]) == {"air", "rain"}


def test_a_capture_is_uploaded_and_named_in_the_result(harness: RoomDeviceHarness) -> None:
    assert harness.done(CaptureRaw(name="image")).result == {"upload": "u1", "media_type": "image/png", "length": 3}
    (stored,) = harness.uploads.stored
    expected = {"device": "arm", "stream": "image", "media_type": "image/png", "content": b"PNG"}
    assert expected.items() <= stored.items()
    assert re.fullmatch(r"arm-image-.*\.png", stored["name"])
    harness.uploads.full = True
    reason = harness.failed(CaptureRaw(name="image"))
    assert (reason.code, reason.message) == ("not_stored", "the store is full; delete something")


def test_a_control_is_set_within_its_limits_and_returns_the_applied_value(harness: RoomDeviceHarness) -> None:
    assert harness.done(SetControl(control="opening", value=0.4)).result == {"applied": {"opening": 0.2}}
    for value in (0.6, -0.1):
        assert harness.failed(SetControl(control="opening", value=value)).code == "out_of_range"
    for value in (math.nan, math.inf):
        with refuses("not_finite"):
            harness.room_device.set("opening", value)
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
    harness: RoomDeviceHarness, request_: Task, code: str, message: str
) -> None:
    reason = harness.failed(request_)
    assert reason.code == code
    assert message in reason.message


def test_actions_without_streams_or_storage_are_rejected(
    make_room_device: MakeRoomDevice, make_device: MakeDevice
) -> None:
    entry = RoomDeviceManifest(name="arm", kind="window", label="Window", driver="fake", captures=("image",))
    harness = make_room_device(uploads=False, entry=entry)
    assert harness.failed(TakePicture()).code == "no_streams"
    assert harness.failed(CaptureRaw(name="image")).code == "no_store"
    assert make_device().failed(TakePicture(), epoch=1).code == "cannot", "a robot"


def test_errors_of_the_driver_are_reported(harness: RoomDeviceHarness) -> None:
    harness.sensor.broken = "it is wet"
    calls = (
        lambda: harness.room_device.take_picture(()),
        lambda: harness.room_device.capture_raw("image"),
        lambda: harness.room_device.set("opening", 0.1),
    )
    for call in calls:
        with pytest.raises(Refused, match="it is wet"):
            call()
