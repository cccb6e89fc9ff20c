"""SQLite on a simulated disk. A power failure loses the transactions that were not synced."""

import os
import random
import sqlite3
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from tests.simulation.engine.scheduler import Process, current_process

Statement = tuple[str, str, Any]
"""Method of the connection, SQL, and values."""
_READS = ("SELECT", "PRAGMA")


class Database:
    """One database file: its content for processes, and the content that survives a power failure."""

    def __init__(self) -> None:
        self.content = _memory()
        self._synced = _memory()
        self._unsynced: list[list[Statement]] = []

    def committed(self, transaction: list[Statement], *, sync: bool) -> None:
        """Record a transaction of ``content``."""
        self._unsynced.append(transaction)
        if sync:
            self.sync()

    def sync(self) -> None:
        """Make everything survive a power failure."""
        self._apply(len(self._unsynced))

    def lose_power(self, rng: random.Random) -> None:
        """Keep a random number of the transactions that were not synced: the log is written in order."""
        self._apply(rng.randint(0, len(self._unsynced)))
        self._unsynced.clear()
        self.content = _memory()
        self._synced.backup(self.content)

    def _apply(self, count: int) -> None:
        for transaction in self._unsynced[:count]:
            for method, sql, values in transaction:
                arguments = (sql,) if method == "executescript" else (sql, values)
                getattr(self._synced, method)(*arguments)
        del self._unsynced[:count]


class Disk:
    """The disk of one machine.

    Attributes:
        full: Whether writes fail.
    """

    def __init__(self) -> None:
        self.full = False
        self.databases: dict[str, Database] = {}

    def database(self, path: str) -> Database:
        if path not in self.databases:
            self.databases[path] = Database()
        return self.databases[path]

    def process_killed(self) -> None:
        """Roll open transactions back."""
        for database in self.databases.values():
            if database.content.in_transaction:
                database.content.execute("ROLLBACK")

    def lose_power(self, rng: random.Random) -> None:
        """See ``Database.lose_power``."""
        self.process_killed()
        for database in self.databases.values():
            database.lose_power(rng)


class Connection:
    """``sqlite3.Connection`` of a process."""

    def __init__(self, process: Process, path: str, accessed: Callable[[], None]) -> None:
        self._process = process
        self._path = path
        self._accessed = accessed
        self._full_sync = False
        self._transaction: list[Statement] | None = None
        self._closed = False

    def execute(self, sql: str, values: Sequence[Any] = ()) -> sqlite3.Cursor:
        return self._run("execute", sql, values)

    def executemany(self, sql: str, values: Iterable[Any]) -> sqlite3.Cursor:
        return self._run("executemany", sql, list(values))

    def executescript(self, sql: str) -> sqlite3.Cursor:
        return self._run("executescript", sql, ())

    def close(self) -> None:
        self._closed = True

    def _run(self, method: str, sql: str, values: Any) -> sqlite3.Cursor:
        if self._closed or not self._process.alive:
            raise sqlite3.ProgrammingError("Cannot operate on a closed database.")
        verb = sql.lstrip()[:6].upper()
        database = self._process.disk.database(self._path)
        if verb == "PRAGMA" and "synchronous" in sql:
            self._full_sync = sql.endswith(("FULL", "EXTRA"))
        if verb in _READS:
            reading: sqlite3.Cursor = database.content.execute(sql, values)
            return reading
        if self._transaction is None:
            self._accessed()
        if self._process.disk.full and verb != "ROLLBA":
            raise sqlite3.OperationalError("database or disk is full")
        arguments = (sql,) if method == "executescript" else (sql, values)
        cursor: sqlite3.Cursor = getattr(database.content, method)(*arguments)
        if verb == "BEGIN ":
            self._transaction = []
        elif verb == "COMMIT":
            database.committed(self._transaction or [], sync=self._full_sync)
            self._transaction = None
        elif verb == "ROLLBA":
            self._transaction = None
        elif self._transaction is not None:
            self._transaction.append((method, sql, values))
        else:
            database.committed([(method, sql, values)], sync=self._full_sync)
        return cursor


def sqlite_namespace(accessed: Callable[[], None]) -> SimpleNamespace:
    """Replacement of the module ``sqlite3``. ``accessed`` is called before each transaction."""

    def connect(path: Path | str, **_: Any) -> Connection:
        process = current_process()
        assert process is not None, "only simulated processes use the simulated disk"
        return Connection(process, str(path), accessed)

    errors = {
        name: value for name, value in vars(sqlite3).items() if isinstance(value, type) and issubclass(value, Exception)
    }
    return SimpleNamespace(connect=connect, Connection=Connection, Row=sqlite3.Row, **errors)


def os_namespace() -> SimpleNamespace:
    """Replacement of the module ``os`` for the journal, which syncs its log through the operating system."""
    descriptors: dict[int, str] = {}

    def open_(path: str, _flags: int, *_: Any) -> int:
        descriptors[len(descriptors)] = path.removesuffix("-wal")
        return len(descriptors) - 1

    def fsync(descriptor: int) -> None:
        process = current_process()
        if process is not None and process.alive:
            process.disk.database(descriptors[descriptor]).sync()

    replaced = {"open": open_, "fsync": fsync, "close": lambda _: None}
    return SimpleNamespace(**{**vars(os), **replaced})


def _memory() -> sqlite3.Connection:
    return sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
