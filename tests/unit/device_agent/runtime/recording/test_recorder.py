"""The recorder's thread: batches, loss of the process, recovery, and its configuration."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent.config.agent_config import Recording
from device_agent.protocol.events import EventKind
from device_agent.runtime.readings import ReadingCache
from device_agent.runtime.recording import recorder as module
from device_agent.runtime.recording.device_recording import DeviceRecording
from device_agent.runtime.recording.folder import RecordingFolder
from device_agent.runtime.recording.live_segment import LiveSegment
from device_agent.runtime.recording.messages import Batch, RecorderStatus
from device_agent.runtime.recording.recorder import Recorder
from device_agent.runtime.recording.recorder_process import RecorderLostError
from device_agent.runtime.storage.outbox_store import OutboxStore
from device_agent.runtime.telemetry.outbox import Outbox
from tests.harness.agent.device_harness import eventually
from tests.harness.agent.recordings.device import MEASURED, Recorded
from tests.harness.agent.recordings.segments import control_rows, limits, session


@pytest.fixture
def recorded() -> Recorded:
    return Recorded()


class FakeProcess:
    """A recorder process that only keeps the batches."""

    def __init__(self) -> None:
        self.batches: list[Batch] = []
        self.status = RecorderStatus()
        self.error: Exception | None = None
        self.closed = False

    def exchange(self, batch: Batch) -> RecorderStatus:
        if self.error is not None:
            raise self.error
        self.batches.append(batch)
        return self.status

    def close(self, *, within_s: float) -> None:
        self.closed = within_s > 0

    def kill(self) -> int:
        return 0


class FakeUploader:
    started = stopped = False

    def start(self) -> None:
        self.started = True

    def stop(self) -> None:
        self.stopped = True


@pytest.fixture
def process() -> FakeProcess:
    return FakeProcess()


@pytest.fixture
def recorder(tmp_path: Path, process: FakeProcess, recorded: Recorded) -> Iterator[Recorder]:
    made = Recorder(limits(tmp_path / "recordings"), owner="s/ann")
    made._process = process  # type: ignore[assignment]
    made.add(recorded.device)
    yield made
    made.stop()


def test_rows_are_sent_and_the_end_of_the_agent_ends_the_session(
    recorder: Recorder, process: FakeProcess, recorded: Recorded
) -> None:
    recorder.start()
    recorded.run(3)
    eventually(lambda: process.batches)
    recorded.run(2)
    recorder.stop()
    assert (sum(len(batch.rows) for batch in process.batches), process.batches[-1].ended) == (5, True)
    assert process.closed


def test_readings_of_the_room_are_sent(recorder: Recorder, process: FakeProcess, recorded: Recorded) -> None:
    recorded.run()
    recorder.record_reading("agent-door", "door", MEASURED)
    recorder._step()
    assert process.batches[0].entries[0].topic == "/room/agent-door/door"


class FakeCameras:
    """The recording of cameras; the first update fails."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def add_session(self, _: DeviceRecording) -> None:
        self.calls.append("add")

    def start(self) -> None:
        self.calls.append("start")

    def update(self) -> None:
        self.calls.append("update")
        if self.calls.count("update") == 1:
            raise RuntimeError("a defect")

    def stop(self) -> None:
        self.calls.append("stop")


def test_recorded_cameras_are_updated_while_the_recorder_runs(
    tmp_path: Path, process: FakeProcess, recorded: Recorded
) -> None:
    cameras = FakeCameras()
    recorder = Recorder(limits(tmp_path / "recordings"), owner="s/ann", cameras=cameras)  # type: ignore[arg-type]
    recorder._process = process  # type: ignore[assignment]
    recorder.add(recorded.device)
    recorder.start()
    eventually(lambda: cameras.calls.count("update") > 1)
    recorder.stop_cameras()
    recorder.stop()
    assert (cameras.calls[:3], "stop" in cameras.calls) == (["add", "start", "update"], True)


def test_without_cameras_their_end_has_no_effect(recorder: Recorder) -> None:
    recorder.stop_cameras()


def test_after_the_loss_of_the_process_it_is_started_again(
    recorder: Recorder, process: FakeProcess, recorded: Recorded
) -> None:
    recorded.run()
    process.error = RecorderLostError("the recorder process has ended (signal SIGKILL)")
    recorder._step()
    assert "SIGKILL" in recorded.device.faults()[0].message
    process.error = None
    recorded.run()
    recorder._step()  # too early
    assert process.batches == []
    recorder._restart_s = float("-inf")
    recorder._step()
    assert [row.sequence for row in process.batches[0].rows] == [1]
    assert recorded.kinds() == [EventKind.RECORDING_FAILED, EventKind.RECORDING_RESUMED]


def test_an_unforeseen_error_does_not_end_the_thread(
    recorder: Recorder, process: FakeProcess, recorded: Recorded
) -> None:
    process.error = RuntimeError("a defect")
    recorder.start()
    recorded.run()
    eventually(lambda: not recorded.device._queue)
    process.error = None
    recorded.run()
    eventually(lambda: process.batches)


def test_deleted_segments_are_reported(recorder: Recorder, process: FakeProcess, recorded: Recorded) -> None:
    process.status = RecorderStatus(deleted=3)
    recorded.run()
    recorder._step()
    assert recorded.events[-1].kind is EventKind.RECORDINGS_DELETED
    assert recorded.events[-1].data == {"segments": 3}


def test_segments_of_a_crash_are_recovered_at_the_start(
    recorder: Recorder, process: FakeProcess, tmp_path: Path
) -> None:
    folder = RecordingFolder(tmp_path / "recordings")
    folder.claim("s/ann")
    live = LiveSegment(folder.live_path("arm", 7, 0), session())
    live.write(control_rows(0, 3), [])
    recorder._step()
    assert process.batches == [Batch()]


def test_without_a_folder_rows_are_discarded_and_uploads_wait(
    recorder: Recorder, process: FakeProcess, recorded: Recorded, tmp_path: Path
) -> None:
    recorder._uploader = uploader = FakeUploader()  # type: ignore[assignment]
    (tmp_path / "recordings").write_text("a file")
    recorded.run()
    recorder._step()
    assert "not recorded" in recorded.device.faults()[0].message
    assert not recorded.device.active
    (tmp_path / "recordings").unlink()
    assert [uploader.started] == [False]
    recorded.run()
    recorder._step()
    assert [row.sequence for row in process.batches[0].rows] == [1]
    assert uploader.started
    recorder.stop()
    assert uploader.stopped


def test_the_configuration_and_windows_disable_recordings(
    tmp_path: Path, outbox: Outbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    readings = ReadingCache(space="s", agent="agent", own=["door"], named=[("door", "door")])
    parts: dict[str, Any] = {"owner": "s/ann", "uploads": None, "outbox": outbox, "readings": readings, "cameras": None}
    assert module.create(Recording(enabled=False), tmp_path, **parts) is None
    with monkeypatch.context() as windows:
        windows.delattr(os, "fork")
        assert module.create(Recording(), tmp_path, **parts) is None
    local = module.create(Recording(upload=False, max_gb=2, min_free_gb=0.5), tmp_path, **parts)
    assert local is not None
    assert local._uploader is None
    assert local._process._limits == limits(
        tmp_path, max_bytes=2 * 10**9, max_age_s=30 * 86_400, min_free_bytes=5 * 10**8
    )
    recorder = module.create(Recording(), tmp_path, **parts)
    assert recorder is not None
    assert recorder._uploader is not None
    assert not recorder._uploader._is_behind()
    recorded = Recorded()
    recorder.add(recorded.device)
    recorded.run()
    readings.record("door", "door", MEASURED)
    assert recorded.take()[0].entries[0].topic == "/room/agent-door/door"


@pytest.fixture
def outbox(tmp_path: Path) -> Outbox:
    store = OutboxStore(tmp_path / "outbox.db", own="ts/", max_bytes=10**6, max_age_ms=10**6)
    return Outbox(store, publish=lambda *_, **__: True, device_topic="ts/v1/s/agent/arm")
