"""The reader yields the rows of one session in their order, and names the file of each problem."""

import shutil
from pathlib import Path

import pytest
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

from device_agent.cli.export.errors import ExportError
from device_agent.cli.export.recording import Recording, open_recording
from device_agent.runtime.recording.format import ControlRow
from tests.harness.agent.recordings.synthetic import FIRST_SEQUENCE, STARTED_NS, Session, write_session

SESSION = Session(periods=100, every=30)


def sequences(recording: Recording) -> list[int]:
    return [row.control.sequence - FIRST_SEQUENCE for row in recording.rows()]


def test_rows_of_all_segments_are_in_order(tmp_path: Path) -> None:
    paths = write_session(tmp_path, SESSION)
    recording = open_recording(list(reversed(paths)))
    assert [row.control for row in recording.rows()] == list(SESSION.rows())
    assert sequences(open_recording([tmp_path])) == list(range(100))


def test_a_span_of_time_includes_both_ends(tmp_path: Path) -> None:
    write_session(tmp_path, SESSION)
    recording = open_recording([tmp_path])
    span_ns = (recording.time_ns(0.5), recording.time_ns(0.7))
    # Once before the times of the segments are known, and once after.
    for _ in range(2):
        rows = list(recording.rows(span_ns))
        assert [row.control.sequence - FIRST_SEQUENCE for row in rows] == list(range(25, 36))
    assert recording.session_s(rows[0].time_ns) == 0.5
    assert rows[0].time_ns == STARTED_NS + 500_000_000


@pytest.mark.parametrize(("lost", "gap"), [(1, False), (2, True), (10, True)])
def test_more_than_two_periods_between_rows_are_a_gap(tmp_path: Path, lost: int, gap: bool) -> None:
    write_session(tmp_path, Session(periods=100, every=30, missing=range(40, 40 + lost)))
    after = [row.control.sequence - FIRST_SEQUENCE for row in open_recording([tmp_path]).rows() if row.after_gap]
    assert after == ([40 + lost] if gap else [])


def test_another_session_is_rejected_with_the_name_of_its_file(tmp_path: Path) -> None:
    paths = write_session(tmp_path / "one", SESSION)
    other = write_session(tmp_path / "two", Session(periods=60, every=30, epoch=7))
    with pytest.raises(ExportError, match=r"two/000001\.mcap has epoch 7, but .*one/000000\.mcap has 6"):
        open_recording([paths[0], other[1]])


def test_another_device_is_rejected(tmp_path: Path) -> None:
    paths = write_session(tmp_path / "one", SESSION)
    other = write_session(tmp_path / "two", Session(periods=60, every=30, device="leg"))
    with pytest.raises(ExportError, match="has device leg, but"):
        open_recording([paths[0], other[1]])


def test_a_segment_twice_is_rejected(tmp_path: Path) -> None:
    paths = write_session(tmp_path, SESSION)
    shutil.copy(paths[1], tmp_path / "copy.mcap")
    with pytest.raises(ExportError, match="is segment 1 once more"):
        open_recording([tmp_path])


def test_a_missing_segment_is_named_or_becomes_a_gap(tmp_path: Path) -> None:
    paths = write_session(tmp_path, SESSION)
    paths[1].unlink()
    with pytest.raises(ExportError, match="lacks segment 1; add --readable"):
        open_recording([tmp_path])
    reports: list[str] = []
    rows = list(open_recording([tmp_path], reports.append).rows())
    assert [row.control.sequence - FIRST_SEQUENCE for row in rows if row.after_gap] == [60]
    assert len(reports) == 1
    assert "lacks segment 1; the export has a gap there" in reports[0]


@pytest.mark.parametrize("finished", [True, False])
def test_a_truncated_file_is_named_or_read_as_far_as_possible(tmp_path: Path, finished: bool) -> None:
    paths = write_session(tmp_path, SESSION, finish=lambda segment: finished or segment < 3)
    if finished:
        paths[3].write_bytes(paths[3].read_bytes()[:-20])
    with pytest.raises(ExportError, match=r"000003\.mcap is truncated or damaged; add --readable"):
        sequences(open_recording([tmp_path]))
    reports: list[str] = []
    recording = open_recording([tmp_path], reports.append)
    assert sequences(recording) == list(range(100))
    assert sequences(recording) == list(range(100))
    assert reports == [f"{paths[3]} is truncated or damaged; the messages after the damage are missing"]


def test_a_segment_that_is_being_written_counts_as_truncated(tmp_path: Path) -> None:
    paths = write_session(tmp_path, SESSION, finish=lambda segment: segment < 3)
    paths[3].rename(paths[3].with_suffix(".live"))
    with pytest.raises(ExportError, match=r"000003\.live is truncated or damaged; add --readable"):
        sequences(open_recording([tmp_path]))
    # A crash after the completion of a segment leaves both files.
    shutil.copy(paths[2], paths[2].with_suffix(".live"))
    reports: list[str] = []
    assert sequences(open_recording([tmp_path], reports.append)) == list(range(100))
    assert len(reports) == 1


def test_an_unfinished_file_is_read_up_to_its_last_whole_message(tmp_path: Path) -> None:
    paths = write_session(tmp_path, SESSION, finish=lambda _: False)
    content = paths[3].read_bytes()
    paths[3].write_bytes(content[: len(content) * 2 // 3])
    reports: list[str] = []
    read = sequences(open_recording([tmp_path], reports.append))
    assert read == list(range(len(read)))
    assert 92 < len(read) < 100
    assert len(reports) == 4


def test_changed_bytes_are_found(tmp_path: Path) -> None:
    path = write_session(tmp_path, Session(periods=30))[0]
    content = bytearray(path.read_bytes())
    with path.open("rb") as file:
        chunk = next(one for one in StreamReader(file, emit_chunks=True).records if isinstance(one, Chunk))
    content[content.index(chunk.data) + len(chunk.data) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(ExportError, match="is truncated or damaged"):
        sequences(open_recording([tmp_path]))


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"no mcap", "is truncated or damaged"), (b"", "is truncated or damaged"), (None, "does not exist")],
)
def test_a_file_that_is_no_recording_is_named(tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / "file.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ExportError, match=rf"file\.mcap {message}"):
        open_recording([path])


def test_a_folder_without_recordings_is_named(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="contains no recording"):
        open_recording([tmp_path])


def test_rows_that_go_back_are_rejected(tmp_path: Path) -> None:
    class Restarted(Session):
        def row(self, period: int) -> ControlRow:
            return super().row(period if period < 60 else period - 10)

    write_session(tmp_path, Restarted(periods=90, every=30))
    with pytest.raises(ExportError, match="row 4050 after row 4059; the files are not one session"):
        sequences(open_recording([tmp_path]))
