"""Stop, interlocks and faults of room devices."""

import threading
from pathlib import Path

import pytest

from device_agent.config.interlock_rule import InterlockRule
from device_agent.ports.sensor import SensorError
from device_agent.protocol import (
    AckStatus,
    CollectData,
    Mode,
    ResetStop,
    SetControl,
    StopDevice,
    TakePicture,
)
from device_agent.protocol.codec import MAX_BYTES
from tests.harness.agent.device_harness import eventually, shown
from tests.unit.device_agent.runtime.room.room_device_fixture import FakeSensor, RoomDeviceHarness, await_growth


def test_a_picture_that_is_too_large_is_a_fault_with_advice(harness: RoomDeviceHarness) -> None:
    harness.device.link_changed(True)
    harness.sensor.picture = bytes(MAX_BYTES)
    state = shown(harness, lambda state: state.faults)
    assert "smaller pictures" in state.faults[0].message


def test_stop_holds_until_reset_while_streams_continue(harness: RoomDeviceHarness) -> None:
    collecting = harness.command(CollectData(rate_hz=20.0, duration_s=3000.0), epoch=harness.epoch())
    eventually(lambda: any(ack.status is AckStatus.STARTED for ack in harness.acks(collecting)))
    harness.command(StopDevice(), epoch=0)
    assert harness.end(collecting).status is AckStatus.FAILED
    eventually(lambda: harness.sensor.holds == 1)
    refused = harness.done(SetControl(control="opening", value=0.1))
    assert (refused.status, refused.reason and refused.reason.code) == (AckStatus.FAILED, "stopped")
    await_growth(harness.measured)
    assert harness.sensor.holds == 1, "hold is called once"
    assert harness.end(harness.command(ResetStop(), epoch=harness.epoch())).status is AckStatus.DONE
    assert harness.done(SetControl(control="opening", value=0.1)).status is AckStatus.DONE


def test_a_sensor_error_is_a_fault_until_the_sensor_responds(harness: RoomDeviceHarness) -> None:
    harness.device.link_changed(True)
    await_growth(harness.measured)
    harness.sensor.broken = "no answer on the bus; is it plugged in?"
    state = shown(harness, lambda state: state.faults)
    assert state.mode is Mode.FAULT
    assert state.faults[0].message == harness.sensor.broken
    refused = harness.done(TakePicture())
    assert (refused.status, refused.reason and refused.reason.code) == (AckStatus.FAILED, "fault")
    harness.sensor.broken = ""
    shown(harness, lambda state: not state.faults)
    await_growth(harness.measured)


def test_a_missing_sensor_at_start_is_a_fault(tmp_path: Path) -> None:
    started = threading.Event()
    original = FakeSensor.connect

    def absent(self: FakeSensor) -> None:
        if not started.is_set():
            raise SensorError("not connected")
        original(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FakeSensor, "connect", absent)
        harness = RoomDeviceHarness(tmp_path)
        try:
            harness.device.link_changed(True)
            assert shown(harness, lambda state: state.faults).faults[0].message == "not connected"
            started.set()
            await_growth(harness.measured)
        finally:
            harness.stop()


def test_an_unexpected_driver_error_is_a_fault_and_the_loop_continues(harness: RoomDeviceHarness) -> None:
    harness.device.link_changed(True)

    def fail(_stream: str) -> dict[str, float]:
        raise ZeroDivisionError

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(harness.sensor, "read", fail)
        assert "internal error" in shown(harness, lambda state: state.faults).faults[0].message
    shown(harness, lambda state: not state.faults)
    await_growth(harness.measured)


def test_an_interlock_holds_a_room_device(tmp_path: Path) -> None:
    rule = InterlockRule(device="other-zone", stream="presence", field="near", equals=1.0, stale_s=5.0)
    harness = RoomDeviceHarness(tmp_path, interlocks=(rule,))
    try:
        refused = harness.done(SetControl(control="opening", value=0.1))
        assert (refused.status, refused.reason and refused.reason.code) == (AckStatus.FAILED, "interlock")
        assert harness.sensor.holds == 1
    finally:
        harness.stop()
