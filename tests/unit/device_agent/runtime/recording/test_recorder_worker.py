"""The recorder process' work, in this process: segments, limits, failures of the disk, recovery and the connection."""

import itertools
import os
import shutil
import threading
from collections.abc import Callable
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import msgspec
import pytest

from device_agent.runtime.recording import recorder_worker
from device_agent.runtime.recording.folder import RecordingFolder
from device_agent.runtime.recording.live_segment import LiveSegment
from device_agent.runtime.recording.messages import Batch, RecordedFrame, RecorderStatus
from device_agent.runtime.recording.recorder_worker import RecorderWorker
from tests.harness.agent.device_harness import eventually
from tests.harness.agent.recordings.segments import (
    STARTED_TICK_NS,
    control_rows,
    limits,
    live_sequences,
    sealed_messages,
    session,
)


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


class Fixture:
    def __init__(self, folder: Path, **changes: Any) -> None:
        self.path = folder / "recordings"
        self.clock = Clock()
        self.files = RecordingFolder(self.path)
        self.worker = RecorderWorker(limits(self.path, **changes), clock_s=self.clock)

    def send(self, first: int, count: int, *, ended: bool = False, epoch: int = 7) -> RecorderStatus:
        status = self.worker.handle(Batch(session=session(epoch=epoch), rows=control_rows(first, count), ended=ended))
        self.worker.maintain()
        return status

    def sealed(self, count: int) -> list[Path]:
        """Paths of the sealed segments, once there are so many and no other files."""

        def probe() -> list[Path]:
            self.worker.maintain()
            paths = sorted(each.path for each in self.files.segments())
            return paths if len(paths) == count and not self.files.live() else []

        found: list[Path] = eventually(probe)
        return found


def frames(count: int, first: int = 0) -> tuple[RecordedFrame, ...]:
    return tuple(
        RecordedFrame("/frames/front", STARTED_TICK_NS + number, 5, bytes(3_000))
        for number in range(first, first + count)
    )


@pytest.fixture
def fixture(tmp_path: Path) -> Fixture:
    return Fixture(tmp_path)


def sequences(path: Path) -> list[int]:
    return [row["sequence"] for row in sealed_messages(path)]


def failing(error: OSError) -> Callable[..., Any]:
    def fail(*_arguments: object) -> None:
        raise error

    return fail


def test_a_session_is_written_at_once_and_sealed_at_its_end(fixture: Fixture) -> None:
    assert fixture.send(0, 5) == RecorderStatus()
    assert live_sequences(fixture.files.live()[0]) == [0, 1, 2, 3, 4]
    fixture.send(5, 2, ended=True)
    assert sequences(fixture.sealed(1)[0]) == list(range(7))


def test_a_segment_ends_after_its_duration(fixture: Fixture) -> None:
    fixture.send(0, 5)
    fixture.clock.now_s += 60
    assert fixture.send(5, 5).segment == 0
    assert fixture.send(10, 5, ended=True).segment == 1
    first, second = fixture.sealed(2)
    assert (sequences(first), sequences(second)) == (list(range(10)), list(range(10, 15)))
    assert (first.name, second.name) == ("0000.mcap", "0001.mcap")


def test_two_sessions_are_recorded_at_the_same_time(fixture: Fixture) -> None:
    fixture.send(0, 1)
    fixture.send(0, 1, epoch=8)
    assert len(fixture.files.live()) == 2


def test_an_empty_end_creates_no_segment(fixture: Fixture) -> None:
    assert fixture.send(0, 0, ended=True) == RecorderStatus()
    assert fixture.files.live() == []


def test_segments_of_a_crash_are_sealed_and_followed_by_a_new_one(fixture: Fixture, tmp_path: Path) -> None:
    fixture.send(0, 5)
    for segment, _ in fixture.worker._live.values():
        os.close(segment.descriptor)  # as at the end of the process
    restarted = Fixture(tmp_path)
    status = restarted.send(7, 2, ended=True)
    assert status.segment == 1
    first, second = restarted.sealed(2)
    assert (sequences(first), sequences(second)) == ([0, 1, 2, 3, 4], [7, 8])


def test_a_segment_that_another_process_writes_is_left_alone(fixture: Fixture) -> None:
    fixture.send(0, 5)
    Fixture(fixture.path.parent).worker.maintain()
    assert fixture.send(5, 1) == RecorderStatus()
    assert live_sequences(fixture.files.live()[0]) == [0, 1, 2, 3, 4, 5]


def test_data_are_synchronized_within_half_a_second(fixture: Fixture, monkeypatch: pytest.MonkeyPatch) -> None:
    synced = []
    original = LiveSegment.sync

    def sync(segment: LiveSegment) -> None:
        synced.append(fixture.clock.now_s)
        original(segment)

    monkeypatch.setattr(LiveSegment, "sync", sync)
    for _ in range(30):
        fixture.send(0, 1)
        fixture.clock.now_s += 0.1
    gaps = [later - earlier for earlier, later in itertools.pairwise(synced)]
    assert max(gaps) <= 0.5 + 1e-9


def test_after_an_error_of_the_disk_recording_resumes_with_a_new_segment(
    fixture: Fixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    fixture.send(0, 3)
    with monkeypatch.context() as patch:
        patch.setattr("os.write", failing(OSError(28, "No space left on device")))
        assert fixture.send(3, 3).error == "the session is not recorded: No space left on device"
    assert "No space" in fixture.send(6, 3).error  # not tried again yet
    fixture.clock.now_s += 5
    assert fixture.send(9, 3) == RecorderStatus(segment=1)
    fixture.send(12, 0, ended=True)
    first, second = fixture.sealed(2)
    assert (sequences(first), sequences(second)) == ([0, 1, 2], [9, 10, 11])


def test_a_failed_synchronization_ends_the_recording(fixture: Fixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LiveSegment, "sync", failing(OSError(5, "Input/output error")))
    fixture.send(0, 3)
    assert "Input/output error" in fixture.send(3, 3).error


def test_without_free_space_nothing_is_recorded(tmp_path: Path) -> None:
    fixture = Fixture(tmp_path, min_free_bytes=10**18)
    assert "less than 1e+09 GB of the disk are free" in fixture.send(0, 3).error
    assert fixture.files.live() == []


def test_recording_stops_when_the_disk_fills_up(fixture: Fixture, monkeypatch: pytest.MonkeyPatch) -> None:
    fixture.worker._limits = limits(fixture.path, min_free_bytes=10**6)
    free = [10**9, 10**9, 0]
    monkeypatch.setattr(RecordingFolder, "free_bytes", lambda _: free.pop(0) if len(free) > 1 else free[0])
    assert fixture.send(0, 3) == RecorderStatus()
    fixture.clock.now_s += 1
    fixture.send(3, 3)
    assert "are free" in fixture.send(6, 3).error


def test_uploaded_segments_make_room_on_a_full_disk(fixture: Fixture, monkeypatch: pytest.MonkeyPatch) -> None:
    fixture.worker._limits = limits(fixture.path, min_free_bytes=10**6)
    monkeypatch.setattr(RecordingFolder, "free_bytes", lambda _: 0 if enforced == [] else 10**9)
    enforced: list[float] = []

    def enforce(*_arguments: object, now_s: float) -> int:
        enforced.append(now_s)
        return 0

    monkeypatch.setattr(RecordingFolder, "enforce", enforce)
    assert fixture.send(0, 3) == RecorderStatus()


def test_beyond_the_size_the_oldest_segments_are_deleted_and_reported(tmp_path: Path) -> None:
    fixture = Fixture(tmp_path)
    fixture.send(0, 50, ended=True)
    path = fixture.sealed(1)[0]
    fixture.worker._limits = limits(fixture.path, max_bytes=10)
    assert fixture.send(0, 5, epoch=8).deleted == 1
    assert not path.exists()


def test_a_size_that_even_one_segment_exceeds_is_an_error(fixture: Fixture) -> None:
    fixture.send(0, 50)
    fixture.worker._limits = limits(fixture.path, max_bytes=10)
    assert "increase max_gb" in fixture.send(0, 5, epoch=8).error


def test_age_and_size_are_checked_every_minute(fixture: Fixture) -> None:
    fixture.send(0, 5, ended=True)
    fixture.sealed(1)
    fixture.worker._limits = limits(fixture.path, max_age_s=-1)
    fixture.clock.now_s += 61
    fixture.worker.maintain()
    assert fixture.files.segments() == []
    assert fixture.worker.handle(Batch()).deleted == 1
    assert fixture.worker.handle(Batch()).deleted == 0


def test_maintenance_survives_an_unreadable_folder(fixture: Fixture, monkeypatch: pytest.MonkeyPatch) -> None:
    assert fixture.send(0, 1) == RecorderStatus()
    monkeypatch.setattr(RecordingFolder, "live", failing(PermissionError(13, "Permission denied")))
    fixture.clock.now_s += 61
    assert fixture.send(1, 1) == RecorderStatus()


def test_closing_seals_everything(fixture: Fixture) -> None:
    fixture.send(0, 5)
    fixture.send(0, 5, epoch=8)
    fixture.worker.close()
    assert (len(fixture.files.segments()), fixture.files.live()) == (2, [])


def test_one_segment_is_sealed_at_a_time(fixture: Fixture) -> None:
    class Sealing:
        alive = True

        def is_alive(self) -> bool:
            return self.alive

        def join(self) -> None:
            return

    fixture.worker._sealing = sealing = Sealing()  # type: ignore[assignment]
    fixture.send(0, 5, ended=True)
    fixture.worker.maintain()
    assert len(fixture.files.live()) == 1
    sealing.alive = False
    fixture.sealed(1)


def test_sealing_that_takes_too_long_does_not_delay_the_end(fixture: Fixture, monkeypatch: pytest.MonkeyPatch) -> None:
    fixture.send(0, 5)
    monkeypatch.setattr(recorder_worker, "_CLOSE_S", -1.0)
    fixture.worker.close()
    assert len(fixture.files.live()) == 1


def test_when_the_agent_ends_everything_is_synchronized(fixture: Fixture, monkeypatch: pytest.MonkeyPatch) -> None:
    fixture.send(0, 5)
    fixture.worker.abandon()
    monkeypatch.setattr(LiveSegment, "sync", failing(OSError(5, "Input/output error")))
    fixture.worker.abandon()
    assert live_sequences(fixture.files.live()[0]) == [0, 1, 2, 3, 4]


def test_sealing_has_the_lowest_priority_and_survives_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nice: list[int] = []
    monkeypatch.setattr("os.nice", nice.append)
    recorder_worker.seal_at_low_priority(tmp_path / "missing.live")
    assert nice == [19]


@pytest.fixture
def nice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.nice", lambda _: None)


@pytest.mark.usefixtures("nice")
def test_batches_arrive_over_a_connection_until_the_agent_closes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, theirs = Pipe()
    monkeypatch.setattr(recorder_worker, "Connection", lambda _: theirs)
    thread = threading.Thread(target=recorder_worker.main)
    thread.start()
    own.send_bytes(msgspec.msgpack.encode(limits(tmp_path / "recordings")))
    own.send_bytes(msgspec.msgpack.encode(Batch(session=session(), rows=control_rows(0, 3))))
    assert msgspec.msgpack.decode(own.recv_bytes(), type=RecorderStatus) == RecorderStatus()
    threading.Event().wait(0.15)  # an interval without a batch
    own.send_bytes(msgspec.msgpack.encode(Batch(closing=True)))
    own.recv_bytes()
    thread.join()
    assert len(RecordingFolder(tmp_path / "recordings").segments()) == 1


def test_the_end_of_the_agent_ends_the_process(tmp_path: Path) -> None:
    own, theirs = Pipe()
    thread = threading.Thread(target=recorder_worker.serve, args=(theirs,))
    thread.start()
    own.send_bytes(msgspec.msgpack.encode(limits(tmp_path / "recordings")))
    own.send_bytes(msgspec.msgpack.encode(Batch(session=session(), rows=control_rows(0, 3))))
    own.close()
    thread.join()
    assert live_sequences(RecordingFolder(tmp_path / "recordings").live()[0]) == [0, 1, 2]
    shutil.rmtree(tmp_path / "recordings")


def test_frames_end_a_segment_at_its_maximum_size_and_count_towards_the_quota(tmp_path: Path) -> None:
    fixture = Fixture(tmp_path, segment_bytes=30_000)
    for first in (0, 5, 10):
        fixture.worker.handle(Batch(session=session(), frames=frames(5, first)))
    fixture.worker.handle(Batch(session=session(), ended=True))
    paths = fixture.sealed(2)
    assert [len(sealed_messages(path, "/frames/front")) for path in paths] == [10, 5]
    assert fixture.files.used_bytes() == sum(each.size for each in fixture.files.segments())
