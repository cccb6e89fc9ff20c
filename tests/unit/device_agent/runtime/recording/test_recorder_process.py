"""The real recorder process: start, loss, hang and end; and a whole device that is recorded."""

import os
import signal
import subprocess
import threading
from collections.abc import Iterator
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import pytest

from device_agent.protocol import Measurements, State
from device_agent.protocol.commands import GrantLease, MoveJoints, ReleaseLease
from device_agent.protocol.events import EventKind
from device_agent.runtime.recording import recorder_process
from device_agent.runtime.recording.folder import RecordingFolder
from device_agent.runtime.recording.messages import Batch, RecorderStatus
from device_agent.runtime.recording.recorder import Recorder
from device_agent.runtime.recording.recorder_process import RecorderLostError, RecorderProcess
from tests.harness.agent.device_harness import DeviceHarness, eventually, wait_for_state
from tests.harness.agent.recordings.segments import control_rows, limits, live_sequences, sealed_messages, session


@pytest.fixture
def process(tmp_path: Path) -> Iterator[RecorderProcess]:
    made = RecorderProcess(limits(tmp_path / "recordings"))
    yield made
    made.kill()


def files(tmp_path: Path) -> RecordingFolder:
    return RecordingFolder(tmp_path / "recordings")


def rows(first: int) -> Batch:
    return Batch(session=session(), rows=control_rows(first, 3))


def test_a_killed_process_loses_no_confirmed_row_and_is_started_again(process: RecorderProcess, tmp_path: Path) -> None:
    assert process.pid == 0
    assert process.exchange(rows(0)) == RecorderStatus()
    assert process.exchange(rows(3)) == RecorderStatus()
    os.kill(process.pid, signal.SIGKILL)
    with pytest.raises(RecorderLostError, match="signal SIGKILL"):
        process.exchange(rows(6))
    assert live_sequences(files(tmp_path).live()[0]) == list(range(6))
    assert process.exchange(rows(9)).segment == 1
    process.close(within_s=60)
    assert process.pid == 0
    found = [[row["sequence"] for row in sealed_messages(each.path)] for each in files(tmp_path).segments()]
    assert sorted(found) == [[0, 1, 2, 3, 4, 5], [9, 10, 11]]


def test_a_process_that_hangs_is_killed(process: RecorderProcess) -> None:
    process.exchange(rows(0))
    os.kill(process.pid, signal.SIGSTOP)
    with pytest.raises(RecorderLostError, match="does not respond"):
        process.exchange(rows(3), within_s=0.1)
    assert process.pid == 0


def test_a_process_that_hangs_at_the_end_is_killed(process: RecorderProcess) -> None:
    process.exchange(rows(0))
    os.kill(process.pid, signal.SIGSTOP)
    process.close(within_s=0.1)
    process.close(within_s=0.1)
    assert process.pid == 0


def test_a_process_that_ends_before_its_response_is_lost(process: RecorderProcess) -> None:
    process.exchange(rows(0))
    running = process._process
    assert running is not None
    os.kill(running.pid, signal.SIGSTOP)
    timer = threading.Timer(0.2, running.kill)
    timer.start()
    with pytest.raises(RecorderLostError, match="SIGKILL"):
        process.exchange(rows(3))
    timer.join()


def test_the_end_of_a_process_is_noticed_while_its_child_keeps_the_connection(process: RecorderProcess) -> None:
    own, _theirs = Pipe()
    with subprocess.Popen(["true"]) as ended:
        ended.wait()
    with pytest.raises(EOFError):
        process._await(own, ended, float("inf"))
    own.close()
    _theirs.close()


def test_an_unusable_interpreter_is_an_error(process: RecorderProcess, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.executable", "/missing/python")
    with pytest.raises(RecorderLostError, match="does not start"):
        process.exchange(rows(0))


def test_an_exit_code_is_shown(process: RecorderProcess, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder_process, "_MODULE", "device_agent.missing")
    with pytest.raises(RecorderLostError, match=r"code 1; see the agent's log"):
        process.exchange(rows(0))


# ------------------------------------------------------------ a whole device


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[Recorder]:
    made = Recorder(limits(tmp_path / "recordings"), owner="s/ann")
    yield made
    made.stop()


@pytest.fixture
def device(tmp_path: Path, recorder: Recorder) -> Iterator[DeviceHarness]:
    harness = DeviceHarness(tmp_path, recorder=recorder)
    harness.start()
    recorder.start()
    yield harness
    harness.stop()


def sessions(tmp_path: Path, count: int) -> list[Any]:
    """Rows of each sealed segment, once there are so many."""
    found = eventually(lambda: len(each := files(tmp_path).segments()) >= count and each)
    return [sealed_messages(each.path) for each in found]


def test_a_device_is_recorded_while_a_lease_is_in_force(device: DeviceHarness, tmp_path: Path) -> None:
    device.done(GrantLease(holder="ann", lease_ms=60_000), epoch=3)
    assert wait_for_state(device, lambda state: state.recording).epoch == 3
    device.device._publish("health", Measurements(tick_ms=1, at_ms=2, sequence=3, values={"temperature_c": 20.0}))
    device.setpoint(3, 1, elbow=4.0)
    eventually(lambda: device.telemetry().setpoint_sequence == 1)
    device.done(ReleaseLease(), epoch=3)
    recorded = sessions(tmp_path, 1)[0]
    wait_for_state(device, lambda state: not state.recording)
    assert [row["sequence"] for row in recorded] == list(range(len(recorded)))
    streamed = [row for row in recorded if row["setpoint_sequence"] == 1]
    assert streamed[0]["requested_rad"][1] == 4.0
    assert "elbow: range" in streamed[0]["limited"]
    assert streamed[0]["seen_tick_ms"] > 0
    path = files(tmp_path).segments()[0].path
    assert "lease-granted" in {event["kind"] for event in sealed_messages(path, "/events")}
    assert len(sealed_messages(path, "/measurements/health")) == 1


def test_an_action_is_recorded_with_the_account_that_started_it(device: DeviceHarness, tmp_path: Path) -> None:
    device.done(MoveJoints(position_rad={"elbow": 0.4}), epoch=5)
    recorded = sessions(tmp_path, 1)[0]
    assert {row["epoch"] for row in recorded} == {5}
    moved = [row for row in recorded if row["source"] == "movement" and row["requested_rad"] != row["commanded_rad"]]
    assert moved[0]["requested_rad"] == [0.0, 0.4]
    assert recorded[-1]["applied_rad"][1] == pytest.approx(0.4)


def test_a_lost_recorder_is_shown_and_control_continues(device: DeviceHarness, recorder: Recorder) -> None:
    device.done(GrantLease(holder="ann", lease_ms=60_000), epoch=3)
    wait_for_state(device, lambda state: state.recording)
    os.kill(recorder._process.pid, signal.SIGKILL)
    eventually(lambda: device.events(EventKind.RECORDING_FAILED))
    device.setpoint(3, 1, elbow=0.0)
    eventually(lambda: device.telemetry().setpoint_sequence == 1)
    eventually(lambda: device.events(EventKind.RECORDING_RESUMED))
    assert wait_for_state(device, lambda state: state.recording).lease is not None
    states = device.published("state", State)
    assert "recording" in {fault.code for state in states for fault in state.faults}
