"""What could not be sent yet, on disk: events, and measurements thinned. One SQLite file with a bound.

The oldest goes first when it is full, measurements before events; how many is remembered until it was told. Not
thread-safe: the outbox's own thread uses it.
"""

import contextlib
import sqlite3
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_SCHEMA = """
CREATE TABLE IF NOT EXISTS kept (
    id INTEGER PRIMARY KEY AUTOINCREMENT, late INTEGER NOT NULL, at_ms INTEGER NOT NULL,
    size INTEGER NOT NULL, topic TEXT NOT NULL, payload BLOB NOT NULL);
CREATE INDEX IF NOT EXISTS in_order ON kept (late, id);
CREATE TABLE IF NOT EXISTS dropped (
    device TEXT NOT NULL, late INTEGER NOT NULL, count INTEGER NOT NULL, PRIMARY KEY (device, late));
"""
_ROW_BYTES = 100
"""What a row costs beside its topic and payload [B], rounded up: ids, index, page overhead."""
_CHUNK = 200
_LOOK_EVERY_MS = 60_000
_DEVICE_LEVELS = 5


class ShelfError(Exception):
    """The disk does not take or give what is kept; the text says why."""


@dataclass(frozen=True, slots=True)
class OutboxItem:
    """One message to be sent when it can be. ``late``: a measurement, else an event. ``at_ms``: its own time."""

    topic: str
    payload: bytes
    at_ms: int
    late: bool


@dataclass(frozen=True, slots=True)
class DroppedCount:
    """How much of one device was dropped and not yet told."""

    device: str
    measurements: int
    events: int


class OutboxStore:
    """The file. The constructor touches nothing.

    Args:
        path: Its folder must exist.
        own: Beginning of the agent's topics; what was kept for another space is deleted.
        max_bytes: Most that is kept [B].
        max_age_ms: Older measurements are dropped [ms].
    """

    def __init__(self, path: Path, *, own: str, max_bytes: int, max_age_ms: int) -> None:
        self._path = path
        self._own = own
        self._max_bytes = max_bytes
        self._max_age_ms = max_age_ms
        self._database: sqlite3.Connection | None = None
        self._bytes = 0
        self._looked_ms = 0

    def open(self) -> None:
        """Open the file, or a new one in its place where it is damaged.

        Raises:
            ShelfError: Neither can be.
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
                raise ShelfError(f"{self._path} cannot be used: {error}") from error

    def _connect(self) -> None:
        self._database = sqlite3.connect(self._path, check_same_thread=False, isolation_level=None)
        self._database.execute("PRAGMA journal_mode=WAL")
        self._database.execute("PRAGMA synchronous=NORMAL")
        self._database.executescript(_SCHEMA)
        for table, column in (("kept", "topic"), ("dropped", "device")):
            self._database.execute(
                f"DELETE FROM {table} WHERE substr({column}, 1, ?) <> ?",  # noqa: S608 (both are written above)  # nosec B608
                (len(self._own), self._own),
            )
        self._bytes = self._database.execute("SELECT coalesce(sum(size), 0) FROM kept").fetchone()[0]

    def close(self) -> None:
        """Close the file. May be called twice."""
        if self._database is not None:
            self._database.close()
            self._database = None

    def put(self, items: Iterable[OutboxItem], *, now_ms: int) -> None:
        """Keep items, all or none, within the bound.

        Args:
            items: Oldest first.
            now_ms: Wall clock [ms since 1970].

        Raises:
            ShelfError: None of them is kept.
        """
        rows = [(item.late, item.at_ms, _size(item), item.topic, item.payload) for item in items]

        def write(database: sqlite3.Connection) -> int:
            database.executemany("INSERT INTO kept (late, at_ms, size, topic, payload) VALUES (?, ?, ?, ?, ?)", rows)
            return self._bytes + sum(row[2] for row in rows)

        self._change(write)
        self.bound(now_ms=now_ms)

    def bound(self, *, now_ms: int) -> None:
        """Drop what is too much, and measurements that are too old; count them.

        Raises:
            ShelfError: It stays as it is.
        """
        if not 0 <= now_ms - self._looked_ms < _LOOK_EVERY_MS:
            self._drop("late = 1 AND at_ms < ?", (now_ms - self._max_age_ms,))
            self._looked_ms = now_ms
        while (excess := self._bytes - self._max_bytes) > 0:
            self._drop("late = ? AND id <= ?", self._oldest(excess))

    def _oldest(self, excess: int) -> tuple[bool, int]:
        """Of which kind to drop, and up to which id, to get rid of ``excess`` bytes or of a good part of them."""
        rows = self._read("SELECT late, id, size FROM kept ORDER BY late DESC, id LIMIT ?", (_CHUNK,))
        late, last, _ = rows[0]
        for kind, number, size in rows:
            if kind != late or excess <= 0:
                break
            last, excess = number, excess - size
        return bool(late), last

    def _drop(self, which: str, values: tuple[object, ...]) -> None:
        def write(database: sqlite3.Connection) -> int:
            gone = database.execute(
                f"DELETE FROM kept WHERE {which} RETURNING late, topic, size",  # noqa: S608 (ours, see above)  # nosec B608
                values,
            ).fetchall()
            for late, topic, _ in gone:
                _count(database, device_of(topic), late=late, count=1)
            return self._bytes - sum(int(row[2]) for row in gone)

        self._change(write)

    def drop(self, ids: Iterable[int]) -> None:
        """Drop items that nobody will ever confirm, and count them.

        Raises:
            ShelfError: Not all of them are dropped.
        """
        for number in ids:
            self._drop("id = ?", (number,))

    def count(self, dropped: Mapping[tuple[str, bool], int]) -> None:
        """Count what was never kept as dropped.

        Args:
            dropped: How many by device and whether they are measurements.

        Raises:
            ShelfError: They are not counted.
        """

        def write(database: sqlite3.Connection) -> int:
            for (device, late), count in dropped.items():
                _count(database, device, late=late, count=count)
            return self._bytes

        self._change(write)

    def after(self, last: int, *, late: bool, limit: int) -> list[tuple[int, OutboxItem]]:
        """The oldest items that came after one, with their ids.

        Raises:
            ShelfError: They cannot be read.
        """
        rows = self._read(
            "SELECT id, topic, payload, at_ms FROM kept WHERE late = ? AND id > ? ORDER BY id LIMIT ?",
            (late, last, limit),
        )
        return [(row[0], OutboxItem(row[1], row[2], row[3], late)) for row in rows]

    def remove(self, ids: Sequence[int]) -> None:
        """Delete what has arrived.

        Raises:
            ShelfError: It is still there, and will be sent once more.
        """

        def write(database: sqlite3.Connection) -> int:
            gone = 0
            for number in ids:
                rows = database.execute("DELETE FROM kept WHERE id = ? RETURNING size", (number,)).fetchall()
                gone += sum(row[0] for row in rows)
            return self._bytes - gone

        self._change(write)

    def tell_dropped(self, event: Callable[[DroppedCount], OutboxItem]) -> None:
        """Keep an event for each device of which something was dropped, and begin to count anew.

        Raises:
            ShelfError: Nothing has changed.
        """

        def write(database: sqlite3.Connection) -> int:
            rows = database.execute(
                "SELECT device, sum(count * late), sum(count * (1 - late)) FROM dropped GROUP BY device"
            ).fetchall()
            items = [event(DroppedCount(*row)) for row in rows]
            database.execute("DELETE FROM dropped")
            for item in items:
                database.execute(
                    "INSERT INTO kept (late, at_ms, size, topic, payload) VALUES (?, ?, ?, ?, ?)",
                    (item.late, item.at_ms, _size(item), item.topic, item.payload),
                )
            return self._bytes + sum(map(_size, items))

        self._change(write)

    def _change(self, write: Callable[[sqlite3.Connection], int]) -> None:
        """One transaction; ``write`` gives how many bytes are kept after it."""
        database = self._use()
        try:
            database.execute("BEGIN IMMEDIATE")
            after = write(database)
            database.execute("COMMIT")
            self._bytes = after
        except sqlite3.Error as error:
            with contextlib.suppress(sqlite3.Error):
                database.execute("ROLLBACK")
            raise ShelfError(f"{self._path} cannot be written ({error}): is the disk full?") from error

    def _read(self, sql: str, values: tuple[object, ...]) -> list[Any]:
        database = self._use()
        try:
            rows: list[Any] = database.execute(sql, values).fetchall()
        except sqlite3.Error as error:
            raise ShelfError(f"{self._path} cannot be read: {error}") from error
        return rows

    def _use(self) -> Any:
        if self._database is None:
            raise ShelfError(f"{self._path} is not open")
        return self._database


def device_of(topic: str) -> str:
    """The part of a topic that names the device."""
    return "/".join(topic.split("/")[:_DEVICE_LEVELS])


def _size(item: OutboxItem) -> int:
    return len(item.payload) + len(item.topic) + _ROW_BYTES


def _count(database: sqlite3.Connection, device: str, *, late: bool, count: int) -> None:
    database.execute(
        "INSERT INTO dropped VALUES (?, ?, ?) ON CONFLICT (device, late) DO UPDATE SET count = count + excluded.count",
        (device, late, count),
    )
