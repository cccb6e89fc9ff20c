"""Files of recordings: numbering, deletion by owner, age and size."""

import os
from pathlib import Path

import pytest

from device_agent.runtime.recording import folder as files
from device_agent.runtime.recording.folder import RecordingFolder, overview_of, uploaded_of
from tests.harness.agent.recordings.segments import limits

NOW_S = 1_700_000_000.0


@pytest.fixture
def folder(tmp_path: Path) -> RecordingFolder:
    return RecordingFolder(tmp_path / "recordings")


def add(folder: RecordingFolder, segment: int, *, epoch: int = 7, uploaded: bool = False, age_s: float = 0.0) -> Path:
    path = folder.live_path("arm", epoch, segment).with_suffix(".mcap")
    path.write_bytes(bytes(900))
    overview_of(path).write_bytes(bytes(100))
    if uploaded:
        uploaded_of(path).touch()
    os.utime(path, (NOW_S - age_s, NOW_S - age_s))
    return path


def test_a_session_has_a_folder_and_numbered_segments(folder: RecordingFolder) -> None:
    folder.folder.mkdir()
    assert folder.live_path("arm", 7, 0) == folder.folder / "arm" / "0000000007" / "0000.live"
    add(folder, 0)
    folder.live_path("arm", 7, 0).touch()
    assert folder.live_path("arm", 7, 0).name == "0002.live"
    assert folder.live_path("arm", 7, 5).name == "0005.live"
    assert folder.live_path("arm", 8, 0).name == "0000.live"
    assert [path.name for path in folder.live()] == ["0001.live"]


def test_segments_are_listed_oldest_first(folder: RecordingFolder) -> None:
    add(folder, 0, epoch=9, age_s=1)
    add(folder, 0, epoch=8, age_s=2, uploaded=True)
    (folder.folder / "arm" / "notes").mkdir()
    (folder.folder / "arm" / "notes" / "0000.mcap").touch()
    found = folder.segments()
    assert [(each.device, each.epoch, each.segment, each.uploaded) for each in found] == [
        ("arm", 8, 0, True),
        ("arm", 9, 0, False),
    ]
    assert {each.size for each in found} == {1000}


def test_only_segments_that_are_not_uploaded_wait(folder: RecordingFolder) -> None:
    newer = add(folder, 1, epoch=8, age_s=1)
    older = add(folder, 0, epoch=7, age_s=2)
    add(folder, 0, epoch=8, age_s=3, uploaded=True)
    assert [each.path for each in folder.waiting()] == [older, newer]
    uploaded_of(older).touch()
    assert [each.path for each in folder.waiting()] == [newer]


def test_an_uploaded_session_is_read_again_only_after_a_change(
    folder: RecordingFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = add(folder, 0, uploaded=True)
    read: list[str] = []
    listdir = os.listdir

    def counted(path: str) -> list[str]:
        read.append(path)
        return listdir(path)

    monkeypatch.setattr(os, "listdir", counted)
    assert folder.waiting() == []
    assert folder.waiting() == []
    assert len(read) == 2, "a change within the same step of the clock would not be seen"
    os.utime(path.parent, (NOW_S, NOW_S))
    for _ in range(3):
        assert folder.waiting() == []
    assert len(read) == 3
    late = add(folder, 1)
    assert [each.path for each in folder.waiting()] == [late]
    files.delete(late)
    files.delete(path)
    assert folder.waiting() == []


def test_old_segments_are_deleted_and_counted_if_not_uploaded(folder: RecordingFolder) -> None:
    add(folder, 0, age_s=101, uploaded=True)
    add(folder, 1, age_s=101)
    new = add(folder, 2, age_s=99)
    assert folder.enforce(limits(folder.folder, max_age_s=100), now_s=NOW_S) == 1
    assert [each.path for each in folder.segments()] == [new]


def test_beyond_the_size_uploaded_segments_are_deleted_first_then_the_oldest(folder: RecordingFolder) -> None:
    paths = [add(folder, number, age_s=10 - number, uploaded=number == 2) for number in range(4)]
    assert folder.enforce(limits(folder.folder, max_bytes=3000), now_s=NOW_S) == 0
    assert [each.path for each in folder.segments()] == [paths[0], paths[1], paths[3]]
    assert folder.enforce(limits(folder.folder, max_bytes=2000), now_s=NOW_S) == 1
    assert [each.path for each in folder.segments()] == [paths[1], paths[3]]


def test_segments_that_are_being_written_count(folder: RecordingFolder) -> None:
    assert (folder.used_bytes(), folder.waiting()) == (0, []), "before the first recording"
    add(folder, 0)
    folder.live_path("arm", 7, 0).write_bytes(bytes(500))
    assert folder.used_bytes() == 1500
    folder.enforce(limits(folder.folder, max_bytes=1400), now_s=NOW_S)
    assert folder.used_bytes() == 500


def test_on_an_almost_full_disk_only_uploaded_segments_are_deleted(folder: RecordingFolder) -> None:
    add(folder, 0, uploaded=True)
    kept = add(folder, 1)
    assert folder.enforce(limits(folder.folder, min_free_bytes=10**18), now_s=NOW_S) == 0
    assert [each.path for each in folder.segments()] == [kept]


def test_deleting_the_last_segment_removes_the_folders(folder: RecordingFolder) -> None:
    first, second = add(folder, 0), add(folder, 1)
    files.delete(first)
    assert second.parent.is_dir()
    files.delete(second)
    assert list(folder.folder.iterdir()) == []


def test_a_file_or_session_that_disappears_has_no_size(
    folder: RecordingFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = add(folder, 0)
    (path.parent / "0001.live").symlink_to("missing")
    assert folder.used_bytes() == 1000
    monkeypatch.setattr(folder, "_sessions", lambda: [str(path.parent), str(path.parent / "missing")])
    assert folder.used_bytes() == 1000


def test_without_anything_to_delete_no_list_of_segments_is_made(
    folder: RecordingFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    add(folder, 0, age_s=50)
    monkeypatch.setattr(folder, "segments", None)
    assert folder.enforce(limits(folder.folder, max_age_s=100, max_bytes=1000), now_s=NOW_S) == 0


def test_recordings_of_a_former_owner_are_deleted(folder: RecordingFolder) -> None:
    folder.claim("space/ann")
    kept = add(folder, 0)
    folder.claim("space/ann")
    assert kept.exists()
    folder.claim("space/bob")
    assert folder.segments() == []
    add(folder, 0)
    (folder.folder / "owner").unlink()
    folder.claim("space/bob")
    assert folder.segments() == []
