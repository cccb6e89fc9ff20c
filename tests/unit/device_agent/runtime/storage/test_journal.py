import errno
import os
import sqlite3
from pathlib import Path

import pytest

from device_agent.protocol import Ack, AckStatus, StopLatch
from device_agent.runtime.storage.journal import Journal, JournalError


def ack(command: str, status: AckStatus = AckStatus.RECEIVED, sequence: int = 1, at_ms: int = 1000) -> Ack:
    return Ack(id=command, status=status, sequence=sequence, at_ms=at_ms, tick_ms=1)


@pytest.fixture
def journal(tmp_path: Path):
    journal = Journal(tmp_path / "journal.db")
    journal.open(now_ms=0)
    yield journal
    journal.close()


def test_a_command_is_recorded_once(journal: Journal) -> None:
    assert journal.begin("arm", ack("c1")) is None
    journal.record(ack("c1", AckStatus.STARTED, 2))
    seen = journal.begin("arm", ack("c1"))
    assert seen is not None
    assert seen.status is AckStatus.STARTED


def test_a_terminal_ack_is_final(journal: Journal) -> None:
    journal.begin("arm", ack("c1"))
    journal.record(ack("c1", AckStatus.DONE, 2))
    journal.record(ack("c1", AckStatus.FAILED, 3))
    seen = journal.begin("arm", ack("c1"))
    assert seen is not None
    assert seen.status is AckStatus.DONE


def test_open_commands_of_a_previous_run_are_failed(tmp_path: Path) -> None:
    before = Journal(tmp_path / "journal.db")
    before.open(now_ms=0)
    before.begin("arm", ack("c1"))
    before.record(ack("c1", AckStatus.STARTED, 2))
    before.begin("arm", ack("c2"))
    before.record(ack("c2", AckStatus.DONE, 2))
    # no close: the process was killed
    after = Journal(tmp_path / "journal.db")
    after.open(now_ms=5)
    assert after.end_open(now_ms=5, tick_ms=5) == 1
    seen = after.begin("arm", ack("c1"))
    assert seen is not None
    assert seen.status is AckStatus.FAILED
    assert seen.sequence == 3
    assert seen.reason is not None
    assert seen.reason.code == "agent_restarted"
    after.close()
    before.close()


def test_acks_are_undelivered_until_the_newest_is_delivered(journal: Journal) -> None:
    first, second = ack("c1"), ack("c1", AckStatus.DONE, 2)
    journal.begin("arm", first)
    journal.record(second)
    journal.delivered(first)
    assert journal.undelivered("arm") == (second,)
    assert journal.undelivered("head") == ()
    journal.delivered(second)
    assert journal.undelivered("arm") == ()


def test_epochs_and_latch_persist_and_epochs_never_decrease(tmp_path: Path) -> None:
    before = Journal(tmp_path / "journal.db")
    before.open(now_ms=0)
    before.save_epoch("arm", epoch=7, burned=5)
    before.save_epoch("arm", epoch=3, burned=6)
    before.save_latch("arm", StopLatch(caller="ann", reason="smoke", at_ms=1))
    after = Journal(tmp_path / "journal.db")
    after.open(now_ms=0)
    record = after.device("arm")
    assert (record.epoch, record.burned) == (7, 6)
    assert record.latch is not None
    assert record.latch.caller == "ann"
    after.save_latch("arm", None)
    assert after.device("arm").latch is None
    assert after.device("other").epoch == 0
    after.close()
    before.close()


def test_session_numbers_increase(tmp_path: Path) -> None:
    numbers = []
    for _ in range(3):
        journal = Journal(tmp_path / "journal.db")
        journal.open(now_ms=0)
        numbers += [journal.next_session(), journal.next_session()]
        journal.close()
    assert numbers == [1, 2, 3, 4, 5, 6]


def test_old_terminal_commands_are_deleted(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal.db")
    journal.open(now_ms=0)
    journal.begin("arm", ack("old"))
    journal.record(ack("old", AckStatus.DONE, 2))
    journal.begin("arm", ack("open"))
    journal.close()
    journal.open(now_ms=8 * 24 * 3600 * 1000)
    assert journal.begin("arm", ack("old")) is None
    assert journal.begin("arm", ack("open")) is not None
    journal.close()


def test_an_invalid_journal_file_is_named_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "journal.db"
    path.write_bytes(b"this is not a database, but long enough to look like one" * 100)
    journal = Journal(path)
    with pytest.raises(JournalError, match=r"journal\.db"):
        journal.open(now_ms=0)
    journal.close()
    assert path.read_bytes().startswith(b"this is not")


def test_a_closed_journal_raises(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal.db")
    with pytest.raises(JournalError):
        journal.next_session()


def test_epochs_are_on_disk_when_they_are_saved(journal: Journal, tmp_path: Path) -> None:
    journal.save_epoch("arm", epoch=9, burned=9)
    with sqlite3.connect(tmp_path / "journal.db") as other:
        assert other.execute("SELECT epoch FROM devices").fetchone() == (9,)
    other.close()


def test_a_delivery_after_close_is_ignored(journal: Journal) -> None:
    journal.close()
    journal.delivered(ack("c1"))
    journal.close()


def test_sync_writes_to_disk_without_blocking_writers(
    journal: Journal, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append(os.fstat(descriptor).st_ino))
    journal.begin("arm", ack("1", AckStatus.RECEIVED))
    with journal._lock:
        journal.sync()
    assert synced == [next(tmp_path.glob("*-wal")).stat().st_ino]


def test_a_failed_sync_raises(journal: Journal, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_: int) -> None:
        raise OSError(errno.EIO, "I/O error")

    monkeypatch.setattr(os, "fsync", fails)
    with pytest.raises(JournalError, match="check the disk"):
        journal.sync()
    journal.close()
    with pytest.raises(JournalError, match="could not be synced"):
        journal.sync()
