"""Bounded on-disk queue of unsent events and measurements: one SQLite file.

When it is full, the oldest messages are dropped, measurements before events. Drops are counted until they have been
reported. Not thread-safe: only the outbox's thread uses it.
"""

import contextlib
import sqlite3
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from device_agent.config.release import OUTBOX_FORMAT

_SCHEMA = """
CREATE TABLE IF NOT EXISTS items (
    id INTEGER PRIMARY KEY AUTOINCREMENT, late INTEGER NOT NULL, at_ms INTEGER NOT NULL,
    size INTEGER NOT NULL, topic TEXT NOT NULL, payload BLOB NOT NULL);
CREATE INDEX IF NOT EXISTS in_order ON items (late, id);
CREATE TABLE IF NOT EXISTS dropped (
    device TEXT NOT NULL, late INTEGER NOT NULL, count INTEGER NOT NULL, PRIMARY KEY (device, late));
"""
_ROW_BYTES = 100
"""Size of a row in addition to topic and payload [B], rounded up: ids, index, page overhead."""
_CHUNK = 200
_AGE_CHECK_PERIOD_MS = 60_000
_DEVICE_LEVELS = 5


class OutboxStoreError(Exception):
    """The file cannot be read or written; the text states why."""


@dataclass(frozen=True, slots=True)
class OutboxItem:
    """One unsent message. ``late``: a measurement, otherwise an event. ``at_ms``: time of its origin."""

    topic: str
    payload: bytes
    at_ms: int
    late: bool


@dataclass(frozen=True, slots=True)
class DroppedCount:
    """Number of dropped messages of one device that have not been reported."""

    device: str
    measurements: int
    events: int


class OutboxStore:
    """The queue. The constructor does not access the disk.

    Args:
        path: Database file; its folder must exist.
        own: Prefix of the agent's topics; messages for another space are deleted.
        max_bytes: Maximum size [B].
        max_age_ms: Maximum age of measurements [ms].

    Attributes:
        stored_bytes: Size of all messages [B].
    """

    def __init__(self, path: Path, *, own: str, max_bytes: int, max_age_ms: int) -> None:
        self._path = path
        self._own = own
        self._max_bytes = max_bytes
        self._max_age_ms = max_age_ms
        self._database: sqlite3.Connection | None = None
        self.stored_bytes = 0
        self._age_checked_ms = 0

    def open(self) -> None:
        """Open the file; a damaged file is moved away and replaced.

        Raises:
            OutboxStoreError: The file cannot be created.
        """
        try:
            self._connect()
        except sqlite3.DatabaseError:
            self.close()
            try:
                with contextlib.suppress(FileNotFoundError):
                    self._path.replace(self._path.with_suffix(".damaged"))
                self._connect()
            except (sqlite3.Error, OSError) as error:
                self.close()
                raise OutboxStoreError(f"{self._path} cannot be used: {error}") from error

    def _connect(self) -> None:
        self._database = sqlite3.connect(self._path, check_same_thread=False, isolation_level=None)
        self._database.execute("PRAGMA journal_mode=WAL")
        self._database.execute("PRAGMA synchronous=NORMAL")
        found = self._database.execute("PRAGMA user_version").fetchone()[0]
        if found > OUTBOX_FORMAT:
            self.close()
            raise OutboxStoreError(f"{self._path} has format {found}: a newer release wrote it; use that release")
        self._database.execute(f"PRAGMA user_version={OUTBOX_FORMAT}")
        self._database.executescript(_SCHEMA)
        for table, column in (("items", "topic"), ("dropped", "device")):
            self._database.execute(
                f"DELETE FROM {table} WHERE substr({column}, 1, ?) <> ?",  # noqa: S608 (constants, see above)  # nosec B608
                (len(self._own), self._own),
            )
        self.stored_bytes = self._database.execute("SELECT coalesce(sum(size), 0) FROM items").fetchone()[0]

    def close(self) -> None:
        """Close the file. May be called twice."""
        if self._database is not None:
            self._database.close()
            self._database = None

    def put(self, items: Iterable[OutboxItem], *, now_ms: int) -> None:
        """Store items atomically, and enforce the bounds.

        Raises:
            OutboxStoreError: None of them is stored.
        """
        rows = [(item.late, item.at_ms, _size(item), item.topic, item.payload) for item in items]

        def write(database: sqlite3.Connection) -> int:
            database.executemany("INSERT INTO items (late, at_ms, size, topic, payload) VALUES (?, ?, ?, ?, ?)", rows)
            return self.stored_bytes + sum(row[2] for row in rows)

        self._change(write)
        self.enforce_bounds(now_ms=now_ms)

    def enforce_bounds(self, *, now_ms: int) -> None:
        """Drop and count messages beyond the maximum size, and measurements beyond the maximum age.

        Raises:
            OutboxStoreError: Nothing has changed.
        """
        if not 0 <= now_ms - self._age_checked_ms < _AGE_CHECK_PERIOD_MS:
            self._drop("late = 1 AND at_ms < ?", (now_ms - self._max_age_ms,))
            self._age_checked_ms = now_ms
        while (excess := self.stored_bytes - self._max_bytes) > 0:
            self._drop("late = ? AND id <= ?", self._oldest(excess))

    def _oldest(self, excess: int) -> tuple[bool, int]:
        """The kind and the highest id of messages to drop, for up to ``excess`` bytes."""
        rows = self._read("SELECT late, id, size FROM items ORDER BY late DESC, id LIMIT ?", (_CHUNK,))
        late, last, _ = rows[0]
        for kind, number, size in rows:
            if kind != late or excess <= 0:
                break
            last, excess = number, excess - size
        return bool(late), last

    def _drop(self, which: str, values: tuple[object, ...]) -> None:
        def write(database: sqlite3.Connection) -> int:
            rows = database.execute(
                f"DELETE FROM items WHERE {which} RETURNING late, topic, size",  # noqa: S608 (constants)  # nosec B608
                values,
            ).fetchall()
            for late, topic, _ in rows:
                _count(database, device_of(topic), late=late, count=1)
            return self.stored_bytes - sum(int(row[2]) for row in rows)

        self._change(write)

    def count(self, dropped: Mapping[tuple[str, bool], int]) -> None:
        """Count messages that were dropped before they were stored."""

        def write(database: sqlite3.Connection) -> int:
            for (device, late), count in dropped.items():
                _count(database, device, late=late, count=count)
            return self.stored_bytes

        self._change(write)

    def after(self, last: int, *, late: bool, limit: int) -> list[tuple[int, OutboxItem]]:
        """The oldest items after an id, with their ids.

        Raises:
            OutboxStoreError: They cannot be read.
        """
        rows = self._read(
            "SELECT id, topic, payload, at_ms FROM items WHERE late = ? AND id > ? ORDER BY id LIMIT ?",
            (late, last, limit),
        )
        return [(row[0], OutboxItem(row[1], row[2], row[3], late)) for row in rows]

    def get(self, ids: Sequence[int]) -> dict[int, OutboxItem]:
        """The items with these ids that are still stored, with their ids.

        Raises:
            OutboxStoreError: They cannot be read.
        """
        places = ",".join("?" * len(ids))
        rows = self._read(f"SELECT id, topic, payload, at_ms, late FROM items WHERE id IN ({places})", tuple(ids))  # noqa: S608 (placeholders)  # nosec B608
        return {row[0]: OutboxItem(row[1], row[2], row[3], bool(row[4])) for row in rows}

    def remove(self, ids: Sequence[int]) -> None:
        """Delete acknowledged items.

        Raises:
            OutboxStoreError: They remain, and will be sent again.
        """

        def write(database: sqlite3.Connection) -> int:
            removed = 0
            for number in ids:
                rows = database.execute("DELETE FROM items WHERE id = ? RETURNING size", (number,)).fetchall()
                removed += sum(row[0] for row in rows)
            return self.stored_bytes - removed

        self._change(write)

    def store_dropped_events(self, event: Callable[[DroppedCount], OutboxItem]) -> None:
        """Store an event for each device with dropped messages, and reset the counts.

        Raises:
            OutboxStoreError: Nothing has changed.
        """

        def write(database: sqlite3.Connection) -> int:
            rows = database.execute(
                "SELECT device, sum(count * late), sum(count * (1 - late)) FROM dropped GROUP BY device"
            ).fetchall()
            items = [event(DroppedCount(*row)) for row in rows]
            database.execute("DELETE FROM dropped")
            for item in items:
                database.execute(
                    "INSERT INTO items (late, at_ms, size, topic, payload) VALUES (?, ?, ?, ?, ?)",
                    (item.late, item.at_ms, _size(item), item.topic, item.payload),
                )
            return self.stored_bytes + sum(map(_size, items))

        self._change(write)

    def _change(self, write: Callable[[sqlite3.Connection], int]) -> None:
        """Run one transaction; ``write`` returns the number of stored bytes after it."""
        database = self._connection()
        try:
            database.execute("BEGIN IMMEDIATE")
            after = write(database)
            database.execute("COMMIT")
            self.stored_bytes = after
        except sqlite3.Error as error:
            with contextlib.suppress(sqlite3.Error):
                database.execute("ROLLBACK")
            raise OutboxStoreError(f"{self._path} cannot be written ({error}): is the disk full?") from error

    def _read(self, sql: str, values: tuple[object, ...]) -> list[Any]:
        database = self._connection()
        try:
            rows: list[Any] = database.execute(sql, values).fetchall()
        except sqlite3.Error as error:
            raise OutboxStoreError(f"{self._path} cannot be read: {error}") from error
        return rows

    def _connection(self) -> Any:
        if self._database is None:
            raise OutboxStoreError(f"{self._path} is not open")
        return self._database


def device_of(topic: str) -> str:
    """The device part of a topic."""
    return "/".join(topic.split("/")[:_DEVICE_LEVELS])


def _size(item: OutboxItem) -> int:
    return len(item.payload) + len(item.topic) + _ROW_BYTES


def _count(database: sqlite3.Connection, device: str, *, late: bool, count: int) -> None:
    database.execute(
        "INSERT INTO dropped VALUES (?, ?, ?) ON CONFLICT (device, late) DO UPDATE SET count = count + excluded.count",
        (device, late, count),
    )
