"""Tables in one SQLite file.

Statements run in the event loop: a read or write takes microseconds, less than a switch to a thread. Several processes
may share the file; SQLite's lock makes each statement and each batch atomic.
"""

import os
import secrets
import sqlite3
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from function_app.adapters.shared import row_codec
from function_app.ports.tables import Conflict, Page, Row, StoreError, Write

BUSY_TIMEOUT_MS = 5_000
"""Maximum time that a writer waits for the writes of other processes, which take less than a millisecond each."""
_PAUSE_S = 0.002

_SCHEMA = """
CREATE TABLE IF NOT EXISTS rows (
    tab TEXT NOT NULL, part TEXT NOT NULL, key TEXT NOT NULL, etag TEXT NOT NULL, data BLOB NOT NULL,
    PRIMARY KEY (tab, part, key)
) WITHOUT ROWID
"""
_GET = "SELECT etag, data FROM rows WHERE tab=? AND part=? AND key=?"
_CREATE = "INSERT INTO rows (tab, part, key, etag, data) VALUES (?,?,?,?,?)"
_REPLACE = "UPDATE rows SET etag=?, data=? WHERE tab=? AND part=? AND key=? AND etag=?"
_DELETE = "DELETE FROM rows WHERE tab=? AND part=? AND key=? AND etag=?"
_QUERY = "SELECT key, etag, data FROM rows WHERE tab=? AND part=? AND key>=? {last} ORDER BY key LIMIT ?"
_QUERY_OPEN = _QUERY.format(last="")
_QUERY_CLOSED = _QUERY.format(last="AND key<?")


class SqliteTables:
    """``Tables`` in the file ``path``. The first call opens or creates it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._db: sqlite3.Connection | None = None

    async def get(self, table: str, partition: str, key: str) -> Row | None:
        found = self._run(_GET, (table, partition, key)).fetchone()
        return None if found is None else row_codec.decode(partition, key, found[1], found[0])

    async def create(self, table: str, row: Row) -> Row:
        return self._write_one(table, Write("create", row))

    async def replace(self, table: str, row: Row) -> Row:
        return self._write_one(table, Write("replace", row))

    async def delete(self, table: str, row: Row) -> None:
        self._write_one(table, Write("delete", row))

    async def query(
        self,
        table: str,
        partition: str,
        *,
        first: str = "",
        last: str | None = None,
        limit: int = 100,
        cursor: str | None = None,
    ) -> Page:
        row_codec.check_limit(limit)
        start = first if cursor is None else max(first, row_codec.read_cursor(cursor))
        if last is None:
            found = self._run(_QUERY_OPEN, (table, partition, start, limit + 1)).fetchall()
        else:
            found = self._run(_QUERY_CLOSED, (table, partition, start, last, limit + 1)).fetchall()
        page = tuple([row_codec.decode(partition, key, data, etag) for key, etag, data in found[:limit]])
        return Page(page, row_codec.write_cursor(found[limit][0]) if len(found) > limit else None)

    async def batch(self, table: str, writes: Sequence[Write]) -> tuple[Row, ...]:
        texts = row_codec.check_batch(writes)
        self._run("BEGIN IMMEDIATE")
        try:
            written = tuple([self._write(table, *each) for each in zip(writes, texts, strict=True)])
            self._run("COMMIT")
        except BaseException:
            self._rollback()
            raise
        return written

    async def close(self) -> None:
        if self._db is not None:
            self._db.close()
            self._db = None

    def _write_one(self, table: str, write: Write) -> Row:
        row_codec.check(write.row)
        return self._write(table, write, b"" if write.kind == "delete" else row_codec.encode(write.row))

    def _write(self, table: str, write: Write, data: bytes) -> Row:
        row = write.row
        if write.kind == "delete":
            self._expect_one(self._run(_DELETE, (table, row.partition, row.key, row.etag)), table, row)
            return row
        etag = secrets.token_hex(8)
        if write.kind == "create":
            try:
                self._run(_CREATE, (table, row.partition, row.key, etag, data))
            except sqlite3.IntegrityError as error:
                raise Conflict(f"{table}: '{row.key}' exists") from error
        else:
            cursor = self._run(_REPLACE, (etag, data, table, row.partition, row.key, row.etag))
            self._expect_one(cursor, table, row)
        return Row(row.partition, row.key, row.data, etag, row.schema)

    @staticmethod
    def _expect_one(cursor: sqlite3.Cursor, table: str, row: Row) -> None:
        if cursor.rowcount != 1:
            raise Conflict(f"{table}: '{row.key}' does not have the expected ETag")

    def _rollback(self) -> None:
        if self._db is not None and self._db.in_transaction:
            self._db.rollback()

    def _run(self, statement: str, values: tuple[Any, ...] = ()) -> sqlite3.Cursor:
        db = self._db or self._open()
        try:
            return db.execute(statement, values)
        except sqlite3.IntegrityError:
            raise
        except UnicodeEncodeError as error:
            raise ValueError("partitions and keys are Unicode text without lone surrogates") from error
        except sqlite3.Error as error:
            raise self._unusable(error) from error

    def _open(self) -> sqlite3.Connection:
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            if not self._path.exists():
                os.close(os.open(self._path, os.O_CREAT | os.O_WRONLY, 0o600))
            db = sqlite3.connect(
                self._path,
                isolation_level=None,
                timeout=BUSY_TIMEOUT_MS / 1000,
                check_same_thread=False,
                cached_statements=64,
            )
        except (OSError, sqlite3.Error) as error:
            raise self._unusable(error) from error
        try:
            _prepare(db)
        except sqlite3.Error as error:
            db.close()
            raise self._unusable(error) from error
        self._db = db
        return db

    def _unusable(self, error: Exception) -> StoreError:
        if isinstance(error, sqlite3.OperationalError | OSError):
            return StoreError(f"the tables in {self._path} cannot be used: {error}. Check disk space and permissions.")
        return StoreError(
            f"the tables in {self._path} are damaged ({error}). Restore a backup, or move the file away to start with "
            "empty tables; no data were deleted."
        )


def _prepare(db: sqlite3.Connection) -> None:
    """Set the journal mode and create the schema. SQLite's busy timeout does not cover these on a new file."""
    end = time.monotonic() + BUSY_TIMEOUT_MS / 1000
    while True:
        try:
            db.execute("PRAGMA journal_mode=WAL")
            db.execute("PRAGMA synchronous=NORMAL")
            db.execute(_SCHEMA)
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY or time.monotonic() > end:
                raise
            time.sleep(_PAUSE_S)
        else:
            return
