"""Journal: commands, acks, epochs and the Stop latch survive a kill."""

import errno
import os
import sqlite3
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import msgspec
import pytest

from device_agent.config.release import JOURNAL_FORMAT
from device_agent.protocol import Ack, AckStatus, Reason, StopLatch
from device_agent.runtime.storage.journal import Journal, JournalError
from tests.fakes.tracing import TRACEPARENT


def ack(command: str, status: AckStatus = AckStatus.RECEIVED, sequence: int = 1, at_ms: int = 1000) -> Ack:
    return Ack(id=command, status=status, sequence=sequence, at_ms=at_ms, tick_ms=1)


DAY_MS = 24 * 3600 * 1000

OpenJournal = Callable[..., Journal]


@pytest.fixture
def open_journal(tmp_path: Path) -> Iterator[OpenJournal]:
    """Opens the journal; again as after a kill, because the previous one is not closed."""
    opened: list[Journal] = []

    def open_one(now_ms: int = 0) -> Journal:
        opened.append(Journal(tmp_path / "journal.db"))
        opened[-1].open(now_ms=now_ms)
        return opened[-1]

    yield open_one
    for journal in opened:
        journal.close()


@pytest.fixture
def journal(open_journal: OpenJournal) -> Journal:
    return open_journal()


def test_a_command_is_recorded_once_and_its_terminal_ack_is_final(journal: Journal) -> None:
    assert journal.begin("arm", ack("c1"), issued_ms=1) is None
    for sequence, status in enumerate((AckStatus.STARTED, AckStatus.DONE, AckStatus.FAILED), 2):
        journal.record(ack("c1", status, sequence))
        stored = journal.begin("arm", ack("c1"), issued_ms=1)
        assert stored is not None
        assert stored.status is (AckStatus.DONE if status is AckStatus.FAILED else status)


def test_a_command_rejected_in_the_first_epoch_is_new_again_in_the_second(journal: Journal) -> None:
    journal.begin("arm", ack("c1"), issued_ms=1)
    reason = Reason(code="stale_epoch", message="", epoch=1)
    journal.record(msgspec.structs.replace(ack("c1", AckStatus.FAILED, 2), reason=reason))
    assert journal.begin("arm", ack("c1"), issued_ms=1, epoch=2) is None


def test_a_command_rejected_because_of_its_epoch_is_new_again_with_a_higher_epoch(journal: Journal) -> None:
    journal.begin("arm", ack("c1"), issued_ms=1, epoch=1)
    rejected = msgspec.structs.replace(
        ack("c1", AckStatus.FAILED, 2), reason=Reason(code="stale_epoch", message="", epoch=7)
    )
    journal.record(rejected)
    for epoch in (1, 6, 7):
        assert journal.begin("arm", ack("c1"), issued_ms=1, epoch=epoch) == rejected
    assert journal.begin("arm", ack("c1"), issued_ms=1, epoch=8) is None
    assert tuple(journal.undelivered("arm").values()) == (ack("c1"),)
    for status in (AckStatus.STARTED, AckStatus.DONE):
        journal.record(ack("c1", status, 2))
        for epoch in (1, 7, 8, 9):
            assert journal.begin("arm", ack("c1"), issued_ms=1, epoch=epoch) == ack("c1", status, 2)


def test_a_command_rejected_for_another_reason_is_not_processed_again(journal: Journal) -> None:
    journal.begin("arm", ack("c1"), issued_ms=1)
    rejected = msgspec.structs.replace(ack("c1", AckStatus.FAILED, 2), reason=Reason(code="stopped", message=""))
    journal.record(rejected)
    assert journal.begin("arm", ack("c1"), issued_ms=1, epoch=8) == rejected


def test_open_commands_of_a_previous_run_are_failed(open_journal: OpenJournal) -> None:
    before = open_journal()
    before.begin("arm", ack("c1"), issued_ms=1)
    before.record(ack("c1", AckStatus.STARTED, 2))
    before.begin("arm", ack("c2"), issued_ms=1)
    before.record(ack("c2", AckStatus.DONE, 2))
    after = open_journal(now_ms=5)
    assert after.end_open(now_ms=5, tick_ms=5) == 1
    stored = after.begin("arm", ack("c1"), issued_ms=1)
    assert stored is not None
    assert (stored.status, stored.sequence) == (AckStatus.FAILED, 3)
    assert stored.reason is not None
    assert stored.reason.code == "agent_restarted"


def test_acks_are_undelivered_until_the_newest_is_delivered(journal: Journal) -> None:
    first, second = ack("c1"), ack("c1", AckStatus.DONE, 2)
    journal.begin("arm", first, issued_ms=1)
    journal.record(second)
    journal.delivered(first)
    assert list(journal.undelivered("arm").values()) == [second]
    assert journal.undelivered("head") == {}
    journal.delivered(second)
    assert journal.undelivered("arm") == {}


def test_undelivered_acks_are_read_in_parts(journal: Journal) -> None:
    acks = [ack(f"c{number}") for number in range(3)]
    for each in acks:
        journal.begin("arm", each, issued_ms=1)
    first = journal.undelivered("arm", limit=2)
    assert list(first.values()) == acks[:2]
    assert list(journal.undelivered("arm", after=max(first), limit=2).values()) == acks[2:]


def test_epochs_and_latch_persist_and_epochs_never_decrease(open_journal: OpenJournal) -> None:
    before = open_journal()
    before.save_epoch("arm", epoch=7, burned=5)
    before.save_epoch("arm", epoch=3, burned=6)
    before.save_latch("arm", StopLatch(caller="ann", reason="smoke", at_ms=1))
    after = open_journal()
    record = after.device("arm")
    assert (record.epoch, record.burned) == (7, 6)
    assert record.latch is not None
    assert record.latch.caller == "ann"
    after.save_latch("arm", None)
    assert after.device("arm").latch is None
    assert after.device("other").epoch == 0


def test_a_latch_of_another_version_still_holds_the_device(open_journal: OpenJournal) -> None:
    journal = open_journal()
    journal.save_latch("arm", StopLatch(caller="line\nbreak", reason="", at_ms=1))
    assert journal.device("arm").latch == StopLatch(caller="unknown (unverified)", reason="", at_ms=0)


def test_session_numbers_increase(open_journal: OpenJournal) -> None:
    numbers = [journal.next_session() for journal in (open_journal(), open_journal()) for _ in range(2)]
    assert numbers == [1, 2, 3, 4]


@pytest.mark.parametrize(("now_ms", "newest_ms"), [(0, 9 * DAY_MS), (400 * DAY_MS, 0), (9 * DAY_MS, 9 * DAY_MS)])
def test_old_terminal_commands_are_deleted_if_both_clocks_agree(
    open_journal: OpenJournal, now_ms: int, newest_ms: int
) -> None:
    before = open_journal()
    for command in ("old", "open"):
        before.begin("arm", ack(command), issued_ms=1000)
    before.record(ack("old", AckStatus.DONE, 2, at_ms=400 * DAY_MS))
    before.begin("arm", ack("new"), issued_ms=newest_ms)
    after = open_journal(now_ms=now_ms)
    deleted = after.begin("arm", ack("old"), issued_ms=1000) is None
    assert deleted is (min(now_ms, newest_ms) > 0)
    assert after.begin("arm", ack("open"), issued_ms=1000) is not None


def test_an_invalid_journal_file_is_named_and_not_deleted(tmp_path: Path) -> None:
    path = tmp_path / "journal.db"
    path.write_bytes(b"this is not a database, but as long as one" * 100)
    journal = Journal(path)
    with pytest.raises(JournalError, match=r"journal\.db"):
        journal.open(now_ms=0)
    journal.close()
    assert path.read_bytes().startswith(b"this is not")


def test_a_full_disk_is_an_error(journal: Journal) -> None:
    journal._execute("PRAGMA max_page_count = 1")
    large = StopLatch(caller="ann", reason="x" * 100_000, at_ms=1)
    with pytest.raises(JournalError, match="is the disk full"):
        journal.save_latch("arm", large)
    assert journal.device("arm").latch is None


def test_any_thread_may_write(journal: Journal) -> None:
    with ThreadPoolExecutor() as other:
        assert other.submit(journal.next_session).result() == 1


def test_writes_are_fast_and_use_little_memory(journal: Journal) -> None:
    settings = [journal._execute(f"PRAGMA {name}")[0][0] for name in ("journal_mode", "synchronous", "cache_size")]
    assert settings == ["wal", 1, -256]


def test_a_closed_journal_raises_but_ignores_deliveries(journal: Journal, tmp_path: Path) -> None:
    journal.begin("arm", ack("c1"), issued_ms=1)
    journal.close()
    assert [path.name for path in tmp_path.iterdir()] == ["journal.db"], "the log is in the file"
    with pytest.raises(JournalError):
        journal.next_session()
    journal.delivered(ack("c1"))
    journal.close()


def test_sync_writes_to_disk_without_blocking_writers(
    journal: Journal, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[tuple[int, int]] = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append((descriptor, os.fstat(descriptor).st_ino)))
    journal.begin("arm", ack("1", AckStatus.RECEIVED), issued_ms=1)
    with journal._lock:
        journal.sync()
    ((descriptor, file),) = synced
    assert file == next(tmp_path.glob("*-wal")).stat().st_ino
    with pytest.raises(OSError, match="descriptor"):
        os.fstat(descriptor)


def test_a_failed_sync_raises(journal: Journal, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_: int) -> None:
        raise OSError(errno.EIO, "I/O error")

    monkeypatch.setattr(os, "fsync", fails)
    with pytest.raises(JournalError, match="check the disk"):
        journal.sync()
    journal.close()
    with pytest.raises(JournalError, match="could not be synced"):
        journal.sync()


@pytest.mark.parametrize(
    "write",
    [
        lambda journal: journal.save_epoch("arm", epoch=1, burned=1),
        lambda journal: journal.save_latch("arm", StopLatch(caller="ann", reason="", at_ms=1)),
        lambda journal: journal.save_movement("arm", "a", "test", "dance", 1),
        lambda journal: journal.next_session(),
        lambda journal: journal.record(ack("c1", AckStatus.DONE, 2)),
    ],
    ids=["epoch", "latch", "movement", "session", "terminal ack"],
)
def test_a_promise_is_on_disk_when_its_call_returns(journal: Journal, write: Callable[[Journal], object]) -> None:
    journal.begin("arm", ack("c1"), issued_ms=1)
    statements: list[str] = []
    assert journal._database is not None
    journal._database.set_trace_callback(statements.append)
    write(journal)
    first, write_statement, last = (each for each in statements if not each.startswith(("BEGIN", "COMMIT")))
    assert (first, last) == ("PRAGMA synchronous=FULL", "PRAGMA synchronous=NORMAL")
    assert write_statement.startswith(("INSERT", "UPDATE"))


def test_an_intermediate_ack_is_not_synced(journal: Journal) -> None:
    journal.begin("arm", ack("c1"), issued_ms=1)
    statements: list[str] = []
    assert journal._database is not None
    journal._database.set_trace_callback(statements.append)
    journal.record(ack("c1", AckStatus.STARTED, 2))
    assert not [each for each in statements if each.startswith("PRAGMA")]


def test_movement_versions_never_decrease_and_belong_to_device_author_type_and_name(journal: Journal) -> None:
    place = ("arm", "a", "test", "dance")
    assert journal.movement(*place) == 0
    for version, stored in ((3, 3), (2, 3), (4, 4)):
        journal.save_movement(*place, version)
        assert journal.movement(*place) == stored
    assert journal.movement("other", "a", "test", "dance") == 0
    assert journal.movement("arm", "other", "test", "dance") == 0
    assert journal.movement("arm", "a", "other", "dance") == 0
    assert journal.movement("arm", "a", "test", "other") == 0


def test_a_device_without_consent_to_cameras_has_number_zero(journal: Journal) -> None:
    assert journal.camera_consent("arm") == (0, b"")
    journal.save_camera_consent("arm", 2, b"{}")
    assert (journal.camera_consent("arm"), journal.camera_consent("other")) == ((2, b"{}"), (0, b""))


def test_an_ended_command_of_a_previous_run_has_its_time_and_is_undelivered(open_journal: OpenJournal) -> None:
    traced = msgspec.structs.replace(ack("c1"), traceparent=TRACEPARENT)
    open_journal().begin("arm", traced, issued_ms=1)
    after = open_journal()
    assert after.end_open(now_ms=7, tick_ms=8) == 1
    (ended,) = after.undelivered("arm").values()
    assert ended.traceparent == TRACEPARENT
    assert (ended.id, ended.status, ended.sequence, ended.at_ms, ended.tick_ms) == ("c1", AckStatus.FAILED, 2, 7, 8)
    assert after.end_open(now_ms=9, tick_ms=9) == 0


def test_a_journal_of_a_newer_format_is_not_opened_and_not_changed(tmp_path: Path, open_journal: OpenJournal) -> None:
    open_journal().close()
    path = tmp_path / "journal.db"
    with closing(sqlite3.connect(path)) as database:
        assert database.execute("PRAGMA user_version").fetchone() == (JOURNAL_FORMAT,)
        database.execute(f"PRAGMA user_version={JOURNAL_FORMAT + 1}")
    before = path.read_bytes()
    journal = Journal(path)
    with pytest.raises(JournalError, match="a newer release wrote it"):
        journal.open(now_ms=0)
    assert journal._database is None
    assert path.read_bytes() == before
