"""Stop, interlocks and faults of room devices."""

import threading
from unittest import mock

import msgspec
import pytest

from device_agent.config.interlock_rule import InterlockRule
from device_agent.ports.sensor import Frame, SensorError
from device_agent.protocol import (
    CollectData,
    Mode,
    ResetStop,
    SetControl,
    State,
    StopDevice,
    TakePicture,
    camera_frames,
)
from device_agent.protocol.codec import MAX_BYTES
from device_agent.protocol.events import EventKind
from device_agent.protocol.manifests.room import Watch
from device_agent.runtime.commands import command_processor
from device_agent.runtime.errors import INTERNAL_ERROR
from device_agent.runtime.supervision import Supervisor
from tests.harness.agent.device_harness import eventually, wait_for_state
from tests.harness.agent.thread_crashes import crash
from tests.unit.device_agent.runtime.room.conftest import MakeRoomDevice
from tests.unit.device_agent.runtime.room.room_device_fixture import ENTRY, FakeSensor, RoomDeviceHarness, await_growth

SET = SetControl(control="opening", value=0.1)


def test_a_picture_that_is_too_large_is_a_fault_with_advice(harness: RoomDeviceHarness) -> None:
    harness.sensor.picture = bytes(MAX_BYTES)
    assert "smaller pictures" in wait_for_state(harness, lambda state: state.faults).faults[0].message


def test_stop_holds_until_reset_while_streams_continue(harness: RoomDeviceHarness) -> None:
    collecting = harness.running(CollectData(rate_hz=20.0, duration_s=3000.0))
    harness.command(StopDevice(), epoch=0)
    assert harness.end_code(collecting) == "stopped"
    eventually(lambda: harness.sensor.holds == 1)
    assert harness.failed(SET).code == "stopped"
    await_growth(harness.measured)
    assert harness.sensor.holds == 1, "hold is called once"
    harness.done(ResetStop())
    harness.done(SET)


def test_a_sensor_error_is_a_fault_until_the_sensor_responds(make_room_device: MakeRoomDevice) -> None:
    harness = make_room_device(broken="not connected")
    assert wait_for_state(harness, lambda state: state.faults).faults[0].message == "not connected"
    harness.sensor.broken = ""
    wait_for_state(harness, lambda state: not state.faults)
    await_growth(harness.measured)
    harness.sensor.broken = "no answer on the bus; is it plugged in?"
    state = wait_for_state(harness, lambda state: state.faults)
    assert (state.mode, state.faults[0].message) == (Mode.FAULT, harness.sensor.broken)
    assert harness.failed(TakePicture()).code == "fault"
    harness.sensor.broken = ""
    wait_for_state(harness, lambda state: not state.faults)
    harness.done(TakePicture())


def test_a_sensor_that_takes_long_to_connect_is_a_fault_and_does_not_delay_the_start(
    make_room_device: MakeRoomDevice,
) -> None:
    sensor, responds = FakeSensor(), threading.Event()
    with mock.patch.object(sensor, "connect", responds.wait):
        harness = make_room_device(sensor=sensor)
        state = wait_for_state(harness, lambda state: state.faults)
        assert (state.mode, state.faults[0].message) == (Mode.FAULT, "The device has not responded yet.")
        assert sensor.reads == {"air": 0, "rain": 0}
        responds.set()
        wait_for_state(harness, lambda state: not state.faults)
    await_growth(harness.measured)


def test_a_failed_sensor_has_a_fault_when_the_start_has_ended(make_room_device: MakeRoomDevice) -> None:
    for _ in range(20):
        harness = make_room_device(broken="not connected")
        assert harness.device._controller.fault == "not connected"


def test_a_frame_of_another_kind_than_the_manifest_declares_is_a_fault(harness: RoomDeviceHarness) -> None:
    frame = Frame(4, 3, b"{}", 0.0, camera_frames.SCAN)
    with mock.patch.object(harness.sensor, "frame", return_value=frame):
        message = wait_for_state(harness, lambda state: state.faults).faults[0].message
    assert message == "garden: the manifest declares the kind 'colour', but the driver sends 'scan'; correct the kind"


def test_an_unexpected_error_while_the_sensor_connects_is_a_fault(make_room_device: MakeRoomDevice) -> None:
    sensor = FakeSensor()
    with mock.patch.object(sensor, "connect", side_effect=ZeroDivisionError):
        harness = make_room_device(sensor=sensor)
        assert wait_for_state(harness, lambda state: state.faults).faults[0].message == INTERNAL_ERROR
    wait_for_state(harness, lambda state: not state.faults)


def test_a_sensor_that_fails_after_each_reconnection_is_one_fault_event_and_log_line(
    make_room_device: MakeRoomDevice, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(command_processor, "FAULT_STABLE_S", 1000.0)
    harness = make_room_device()
    reconnections = []

    def fail(_: str) -> None:
        reconnections.append(harness.sensor.closed)
        raise SensorError("no answer on the bus")

    with mock.patch.object(harness.sensor, "read", fail):
        fault = wait_for_state(harness, lambda state: state.faults).faults[0]
        eventually(lambda: len(reconnections) >= 5)
    assert (fault.code, fault.message) == ("driver", "no answer on the bus")
    assert len(harness.events(EventKind.DRIVER_FAILED)) == 1
    assert harness.events(EventKind.DRIVER_RECOVERED) == []
    assert len([record for record in caplog.records if "no answer" in record.getMessage()]) == 1


def test_an_unexpected_driver_error_is_a_fault_with_one_traceback_and_the_loop_continues(
    harness: RoomDeviceHarness, caplog: pytest.LogCaptureFixture
) -> None:
    reads: list[str] = []

    def fail(stream: str) -> None:
        reads.append(stream)
        raise ZeroDivisionError

    with mock.patch.object(harness.sensor, "read", fail):
        assert wait_for_state(harness, lambda state: state.faults).faults[0].message == INTERNAL_ERROR
        eventually(lambda: len(reads) >= 3)
    assert len([record for record in caplog.records if record.exc_info]) == 1
    wait_for_state(harness, lambda state: not state.faults)
    await_growth(harness.measured)


def test_a_silent_stream_is_a_fault_of_its_own(make_room_device: MakeRoomDevice) -> None:
    entry = msgspec.structs.replace(ENTRY, watch=(Watch(source="rain", silent_s=0.1),))
    harness = make_room_device(entry=entry)
    assert wait_for_state(harness, lambda state: state.faults).faults[0].code == "silent.rain"
    with mock.patch.object(harness.sensor, "read", return_value={"mm": 1.0}):
        wait_for_state(harness, lambda state: not state.faults)
    assert harness.events(EventKind.DRIVER_FAILED) == harness.events(EventKind.DRIVER_RECOVERED) == []


def test_an_interlock_holds_a_room_device(make_room_device: MakeRoomDevice) -> None:
    rule = InterlockRule(device="other-zone", stream="presence", field="near", equals=1.0, stale_s=5.0)
    harness = make_room_device(interlocks=(rule,))
    assert harness.failed(SET).code == "interlock"
    assert harness.sensor.holds == 1


def test_a_dead_loop_holds_at_a_stop_is_reported_and_is_started_again(make_room_device: MakeRoomDevice) -> None:
    supervisor = Supervisor()
    harness = make_room_device(supervisor=supervisor)
    supervisor.check()
    crash(harness.device._loop._thread)
    harness.receive_stop()
    assert harness.sensor.holds == 1
    harness.sensor.broken = "no answer"  # until then, the loop that is started again stays in the mode "fault"
    assert supervisor.check() == ""

    def reported(state: State) -> bool:
        return state.mode is Mode.FAULT and any(fault.code == "agent.sensor-loop" for fault in state.faults)

    wait_for_state(harness, reported)
    harness.sensor.broken = ""
    eventually(lambda: not supervisor.check() and harness.events(EventKind.PART_RECOVERED))
    wait_for_state(harness, lambda state: not state.faults and state.mode is Mode.STOPPED)
    await_growth(harness.measured)
