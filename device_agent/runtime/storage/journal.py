"""Write-ahead journal of an agent: commands, epochs, Stop latches, movement versions, consents and the session number.

One SQLite file per agent. Epochs, latches, versions, consents and terminal acks are on disk when their call returns.
Other acks survive a crash of the agent, but not a power failure. Before a command moves a device, ``sync`` writes them
to disk.
"""

import contextlib
import os
import sqlite3
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from device_agent.config.release import JOURNAL_FORMAT
from device_agent.protocol import Ack, AckStatus, Reason, StopLatch, codec
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.state import unverified

_SCHEMA = """
CREATE TABLE IF NOT EXISTS commands (
    id TEXT PRIMARY KEY, device TEXT NOT NULL, last_ack BLOB NOT NULL,
    terminal INTEGER NOT NULL, delivered INTEGER NOT NULL, at_ms INTEGER NOT NULL);
CREATE INDEX IF NOT EXISTS undelivered ON commands (device) WHERE delivered = 0;
CREATE TABLE IF NOT EXISTS devices (
    device TEXT PRIMARY KEY, epoch INTEGER NOT NULL DEFAULT 0, burned INTEGER NOT NULL DEFAULT 0, latch BLOB);
CREATE TABLE IF NOT EXISTS movements (
    device TEXT NOT NULL, author TEXT NOT NULL, robot_type TEXT NOT NULL, name TEXT NOT NULL, version INTEGER NOT NULL,
    PRIMARY KEY (device, author, robot_type, name)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS camera_consents (device TEXT PRIMARY KEY, number INTEGER NOT NULL, consent BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS counters (name TEXT PRIMARY KEY, value INTEGER NOT NULL);
"""
_CACHE_KB = 256
"""Rows are accessed individually by key, so a larger cache would only use memory [kB]."""
_KEEP_MS = 8 * 24 * 3600 * 1000
"""Commands are stored for this time after their issue [ms]: longer than any ``ttl_ms`` (at most a day), so that none
runs twice, and than the week in which the cloud asks for their outcome."""


class JournalError(Exception):
    """The journal cannot be read or written; the text states what to do. The agent must not run without it."""


@dataclass(frozen=True, slots=True)
class DeviceRecord:
    """Persistent state of a device: highest epoch seen, highest epoch burned, Stop latch."""

    epoch: int = 0
    burned: int = 0
    latch: StopLatch | None = None


class Journal:
    """The journal of an agent. Thread-safe."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._database: sqlite3.Connection | None = None

    def open(self, *, now_ms: int) -> None:
        """Open or create the file, and delete commands that were issued more than eight days ago.

        The cloud's clock decides, as the newest command shows it. If either clock was wrongly set ahead, the other one
        prevents that commands are deleted whose duplicates may still arrive.

        Args:
            now_ms: The agent's wall clock [ms since 1970].

        Raises:
            JournalError: The file cannot be read, or is not a journal.
        """
        try:
            self._database = sqlite3.connect(self._path, check_same_thread=False, isolation_level=None)
            self._database.execute("PRAGMA journal_mode=WAL")
            self._database.execute("PRAGMA synchronous=NORMAL")
            self._database.execute(f"PRAGMA cache_size=-{_CACHE_KB}")
            self._check_format(self._database)
            self._database.executescript(_SCHEMA)
            self._database.execute(
                "DELETE FROM commands WHERE terminal = 1 AND at_ms < min(?, (SELECT max(at_ms) FROM commands)) - ?",
                (now_ms, _KEEP_MS),
            )
        except sqlite3.Error as error:
            raise JournalError(
                f"the journal {self._path} cannot be used ({error}). Move it away to start with an empty one; the "
                "agent then needs a new lease for each device and will not know which commands it has already run."
            ) from error

    def _check_format(self, database: sqlite3.Connection) -> None:
        found = database.execute("PRAGMA user_version").fetchone()[0]
        if found > JOURNAL_FORMAT:
            self.close()
            raise JournalError(
                f"the journal {self._path} has format {found}, and this release reads up to {JOURNAL_FORMAT}: a newer "
                "release wrote it. Use that release; do not delete the journal"
            )
        if found < JOURNAL_FORMAT:
            database.execute(f"PRAGMA user_version={JOURNAL_FORMAT}")

    def close(self) -> None:
        """Close the file. May be called twice."""
        with self._lock:
            if self._database is not None:
                self._database.close()
                self._database = None

    def begin(self, device: str, ack: Ack, *, issued_ms: int, epoch: int = 0) -> Ack | None:
        """Record a command before it is processed; see ``sync``.

        Args:
            device: Name of the device.
            ack: Its first ack.
            issued_ms: When the cloud issued it, by the cloud's clock [ms since 1970].
            epoch: Its epoch.

        Returns:
            ``None`` for a new command, and for one that was rejected because of its epoch and now has a higher one than
            the device had seen: it has not run. For a duplicate, its last ack: it must not be processed again.
        """
        with self._lock:
            rows = self._execute(
                "INSERT INTO commands VALUES (?, ?, ?, ?, 0, ?) ON CONFLICT (id) DO NOTHING RETURNING id",
                (ack.id, device, codec.encode(ack), ack.status.terminal, issued_ms),
            )
            if rows:
                return None
            last = codec.decode(self._execute("SELECT last_ack FROM commands WHERE id = ?", (ack.id,))[0][0], Ack)
            if last.reason is None or not 0 < last.reason.epoch < epoch:
                return last
            self._execute(
                "UPDATE commands SET last_ack = ?, terminal = ?, delivered = 0, at_ms = ? WHERE id = ?",
                (codec.encode(ack), ack.status.terminal, issued_ms, ack.id),
            )
            return None

    def record(self, ack: Ack) -> None:
        """Record the newest ack of a command; a terminal ack is on disk when this returns."""
        with self._lock, self._on_disk() if ack.status.terminal else contextlib.nullcontext():
            self._execute(
                "UPDATE commands SET last_ack = ?, terminal = ?, delivered = 0 WHERE id = ? AND terminal = 0",
                (codec.encode(ack), ack.status.terminal, ack.id),
            )

    def sync(self) -> None:
        """Write all records to disk, so that no recorded command runs again after a restart.

        The sync takes most of a millisecond and does not block writers: all records are in SQLite's write-ahead log or
        already in the file, and any process may sync the log.

        Raises:
            JournalError: It is closed, or the disk fails.
        """
        try:
            log = os.open(f"{self._path}-wal", os.O_RDWR)
            try:
                os.fsync(log)
            finally:
                os.close(log)
        except OSError as error:
            raise JournalError(f"the journal {self._path} could not be synced ({error}); check the disk") from error

    def delivered(self, ack: Ack) -> None:
        """Record that an ack was delivered, unless a newer one has been recorded since."""
        with self._lock:
            if self._database is not None:
                self._execute(
                    "UPDATE commands SET delivered = 1 WHERE id = ? AND last_ack = ?", (ack.id, codec.encode(ack))
                )

    def undelivered(self, device: str, *, after: int = 0, limit: int = -1) -> dict[int, Ack]:
        """The last acks of this device's commands that may not have been delivered: number of the row → ack.

        Args:
            device: Name of the device.
            after: Only rows with a higher number, in order.
            limit: Maximum number of rows; -1: all.
        """
        with self._lock:
            rows = self._execute(
                "SELECT rowid, last_ack FROM commands WHERE device = ? AND delivered = 0 AND rowid > ? "
                "ORDER BY rowid LIMIT ?",
                (device, after, limit),
            )
        return {number: codec.decode(ack, Ack) for number, ack in rows}

    def end_open(self, *, now_ms: int, tick_ms: int) -> int:
        """Fail every command that a previous run did not finish. Called at start.

        Returns:
            Number of these commands. They do not run again, because the device may have moved already.
        """
        reason = Reason(code="agent_restarted", message="the agent restarted while this ran; it was not run again")
        with self._lock:
            rows = self._execute("SELECT last_ack FROM commands WHERE terminal = 0")
        for row in rows:
            last = codec.decode(row[0], Ack)
            self.record(
                Ack(
                    id=last.id,
                    status=AckStatus.FAILED,
                    sequence=last.sequence + 1,
                    at_ms=now_ms,
                    tick_ms=tick_ms,
                    reason=reason,
                    traceparent=last.traceparent,
                )
            )
        return len(rows)

    def device(self, device: str) -> DeviceRecord:
        """Persistent state of a device; all zero for a new one."""
        with self._lock:
            rows = self._execute("SELECT epoch, burned, latch FROM devices WHERE device = ?", (device,))
        if not rows:
            return DeviceRecord()
        epoch, burned, latch = rows[0]
        return DeviceRecord(epoch, burned, _latch(latch) if latch else None)

    def save_epoch(self, device: str, *, epoch: int, burned: int) -> None:
        """Record a device's epochs; they never decrease."""
        with self._lock, self._on_disk():
            self._execute(
                "INSERT INTO devices (device, epoch, burned) VALUES (?, ?, ?) ON CONFLICT (device) DO UPDATE SET "
                "epoch = max(epoch, excluded.epoch), burned = max(burned, excluded.burned)",
                (device, epoch, burned),
            )

    def save_latch(self, device: str, latch: StopLatch | None) -> None:
        """Record a device's Stop latch."""
        with self._lock, self._on_disk():
            self._execute(
                "INSERT INTO devices (device, latch) VALUES (?, ?) "
                "ON CONFLICT (device) DO UPDATE SET latch = excluded.latch",
                (device, codec.encode(latch) if latch else None),
            )

    def movement(self, device: str, author: str, robot_type: str, name: str) -> int:
        """The highest version of a movement that has run on a device; 0 for none."""
        with self._lock:
            rows = self._execute(
                "SELECT version FROM movements WHERE device = ? AND author = ? AND robot_type = ? AND name = ?",
                (device, author, robot_type, name),
            )
        return int(rows[0][0]) if rows else 0

    def save_movement(self, device: str, author: str, robot_type: str, name: str, version: int) -> None:
        """Record the version of a movement that runs; it never decreases."""
        with self._lock, self._on_disk():
            self._execute(
                "INSERT INTO movements VALUES (?, ?, ?, ?, ?) ON CONFLICT (device, author, robot_type, name) "
                "DO UPDATE SET version = max(version, excluded.version)",
                (device, author, robot_type, name, version),
            )

    def camera_consent(self, device: str) -> tuple[int, bytes]:
        """Number and content of the newest consent to record a device's cameras; 0 and nothing if there is none."""
        with self._lock:
            rows = self._execute("SELECT number, consent FROM camera_consents WHERE device = ?", (device,))
        return rows[0] if rows else (0, b"")

    def save_camera_consent(self, device: str, number: int, consent: bytes) -> None:
        """Record a consent; an older one changes nothing."""
        with self._lock, self._on_disk():
            self._execute(
                "INSERT INTO camera_consents VALUES (?, ?, ?) ON CONFLICT (device) DO UPDATE SET "
                "number = excluded.number, consent = excluded.consent WHERE excluded.number > number",
                (device, number, consent),
            )

    def next_session(self) -> int:
        """The next session number of this agent's link."""
        with self._lock, self._on_disk():
            rows = self._execute(
                "INSERT INTO counters VALUES ('session', 1) ON CONFLICT (name) DO UPDATE SET value = value + 1 "
                "RETURNING value"
            )
        return int(rows[0][0])

    @contextlib.contextmanager
    def _on_disk(self) -> Iterator[None]:
        """Sync this write and all previous ones to disk."""
        self._execute("PRAGMA synchronous=FULL")
        try:
            yield
        finally:
            with contextlib.suppress(JournalError):  # the original error propagates
                self._execute("PRAGMA synchronous=NORMAL")

    def _execute(self, sql: str, values: tuple[object, ...] = ()) -> list[Any]:
        if self._database is None:
            raise JournalError("the journal is closed")
        try:
            return self._database.execute(sql, values).fetchall()
        except sqlite3.Error as error:
            raise JournalError(f"the journal {self._path} cannot be written ({error}): is the disk full?") from error


def _latch(payload: bytes) -> StopLatch:
    """The stored Stop latch. One that cannot be read, for example of another version, still holds the device."""
    try:
        return codec.decode(payload, StopLatch)
    except ProtocolError:
        return StopLatch(caller=unverified(""), reason="", at_ms=0)
