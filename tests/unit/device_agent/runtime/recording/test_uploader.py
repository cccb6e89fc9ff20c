"""Uploads of segments: order, repetition after failures and restarts, and priority of messages."""

import time
from pathlib import Path

import pytest

from device_agent.ports.uploads import SegmentUpload, UploadError
from device_agent.runtime.recording import sealing, uploader
from device_agent.runtime.recording.folder import RecordingFolder, overview_of
from device_agent.runtime.recording.live_segment import LiveSegment
from device_agent.runtime.recording.uploader import RecordingUploader
from tests.harness.agent.device_harness import eventually
from tests.harness.agent.recordings.segments import STARTED_NS, control_rows, session


class Site:
    """A folder with segments, and a cloud that can fail."""

    def __init__(self, folder: Path) -> None:
        self.files = RecordingFolder(folder / "recordings")
        self.files.folder.mkdir()
        self.stored: list[SegmentUpload] = []
        self.failing: set[int] = set()
        self.behind = False
        self.now_s = 0.0
        self.uploader = self.start()

    def start(self) -> RecordingUploader:
        return RecordingUploader(self.files.folder, self, is_behind=lambda: self.behind, clock_s=lambda: self.now_s)

    def store_segment(self, segment: SegmentUpload) -> None:
        if segment.segment in self.failing:
            raise UploadError("the cloud cannot be reached")
        self.stored.append(segment)

    def add(self, segment: int) -> Path:
        live = LiveSegment(self.files.live_path("arm", 7, segment), session(segment=segment))
        live.write(control_rows(0, 126), [])
        sealing.seal(live.path)
        time.sleep(0.01)  # another modification time
        return live.path.with_suffix(".mcap")

    def uploaded(self) -> list[int]:
        return [each.segment for each in self.stored]


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


def test_segments_are_uploaded_once_with_their_description(site: Site) -> None:
    path = site.add(0)
    site.add(1)
    site.uploader.upload()
    site.uploader.upload()
    site.start().upload()  # a restarted agent
    assert site.uploaded() == [0, 1]
    first = site.stored[0]
    started_ms = STARTED_NS // 1_000_000
    assert (first.device, first.epoch, first.rows) == ("arm", 7, 126)
    assert (first.started_ms, first.ended_ms) == (started_ms, started_ms + 1000)
    assert (first.content, first.overview) == (path.read_bytes(), overview_of(path).read_bytes())


def test_a_failed_upload_is_repeated_later_and_does_not_block_others(site: Site) -> None:
    site.add(0)
    site.add(1)
    site.failing = {0}
    site.uploader.upload()
    assert site.uploaded() == []
    site.uploader.upload()
    assert site.uploaded() == [1]
    site.failing = set()
    site.uploader.upload()
    assert site.uploaded() == [1]
    site.now_s += uploader.FIRST_PAUSE_S
    site.uploader.upload()
    assert site.uploaded() == [1, 0]


def test_the_pause_between_attempts_grows_to_a_limit(site: Site) -> None:
    path = site.add(0)
    site.failing = {0}
    pauses = []
    for _ in range(9):
        site.uploader.upload()
        pauses.append(site.uploader._failed[path][1])
        site.now_s += pauses[-1]
    assert pauses == [10, 20, 40, 80, 160, 320, 600, 600, 600]


def test_messages_have_priority(site: Site) -> None:
    site.add(0)
    site.behind = True
    site.uploader.upload()
    assert site.uploaded() == []


def test_an_unforeseen_error_does_not_end_the_thread(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    site.add(0)
    monkeypatch.setattr(sealing, "describe", None)
    site.uploader.upload()
    assert site.uploaded() == []


def test_the_thread_uploads_until_it_is_stopped(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploader, "PERIOD_S", 0.01)
    site.add(0)
    site.uploader.start()
    eventually(site.uploaded)
    site.uploader.stop()
    site.add(1)
    site.uploader.upload()
    assert site.uploaded() == [0]


def test_an_upload_names_the_other_segments_that_are_not_uploaded(site: Site) -> None:
    for segment in (0, 2, 3):
        site.add(segment)
    live = LiveSegment(site.files.live_path("arm", 7, 4), session(segment=4))
    LiveSegment(site.files.live_path("arm", 8, 0), session(epoch=8))
    site.failing = {2}
    site.uploader.upload()
    site.uploader.upload()
    assert [(each.segment, each.pending) for each in site.stored] == [(0, (2, 3, 4)), (3, (2, 4))]
    live.path.unlink()
    site.failing.clear()
    site.now_s += 3600
    site.uploader.upload()
    assert (site.stored[-1].segment, site.stored[-1].pending) == (2, ())
