"""Tables in one SQLite file.

Statements run in the event loop: a read or write takes microseconds, less than a switch to a thread. A write of a
durable row also waits for the disk. Several processes may share the file; SQLite's lock makes each statement and each
batch atomic. ``table_file`` describes how damage is detected.
"""

import asyncio
import logging
import os
import secrets
import sqlite3
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from function_app.adapters.local import table_file
from function_app.adapters.local.table_file import RowKey
from function_app.adapters.shared import row_codec
from function_app.ports.tables import RELAXED, Conflict, Page, Row, StoreError, StoreFullError, Write, is_durable

FORMAT = 1
"""Format of the file (``user_version``). 0: written by a version without checksums, or new."""
BUSY_TIMEOUT_MS = 5_000
"""Maximum time that a writer waits for the writes of other processes, which take less than a few milliseconds each."""
_PAUSE_S = 0.002
_NORMAL, _FULL = 1, 2
"""Values of ``PRAGMA synchronous``: when the log is written to disk, at a checkpoint or at each commit."""

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

_DAMAGED = frozenset({sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_ERROR})
"""SQLite's codes for a damaged file; the last one for a missing table."""
_SQLITE_ERRORS = (sqlite3.Error, UnicodeError)
"""SQLite's message may quote damaged text, which Python cannot decode."""
_log = logging.getLogger(__name__)


class SqliteTables:
    """``Tables`` in the file ``path``. The first call opens or creates it.

    Args:
        path: The file.
        max_bytes: Maximum size of the file; 0: no limit.
    """

    def __init__(self, path: Path, *, max_bytes: int = 0) -> None:
        self._path = path
        self._max_bytes = max_bytes
        self._db: sqlite3.Connection | None = None
        self._log = table_file.log_of(path)
        self._files: tuple[int, int, int, int] | None = None
        """Device and inode of the file and of its log since the file was opened."""
        self._synchronous = _NORMAL
        self._found: tuple[str, ...] = ()

    async def get(self, table: str, partition: str, key: str) -> Row | None:
        found = self._read(_GET, (table, partition, key))
        return table_file.decode(RowKey(table, partition, key), *found[0]) if found else None

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
            found = self._read(_QUERY_OPEN, (table, partition, start, limit + 1))
        else:
            found = self._read(_QUERY_CLOSED, (table, partition, start, last, limit + 1))
        page = tuple(
            [table_file.decode(RowKey(table, partition, key), etag, data) for key, etag, data in found[:limit]]
        )
        return Page(page, row_codec.write_cursor(found[limit][0]) if len(found) > limit else None)

    async def batch(self, table: str, writes: Sequence[Write]) -> tuple[Row, ...]:
        texts = row_codec.check_batch(writes)
        self._prepare_write(table, writes)
        self._run("BEGIN IMMEDIATE")
        try:
            written = tuple([self._write(table, *each) for each in zip(writes, texts, strict=True)])
            self._run("COMMIT")
        except BaseException:
            self._rollback()
            raise
        return written

    async def check(self, *, thorough: bool = False) -> tuple[str, ...]:
        if thorough:
            self._run("SELECT 1")  # creates the file
            self._found = tuple(await asyncio.to_thread(lambda: list(table_file.damage(self._path))))
        problems = [*table_file.kept_files(self._path), *self._found]
        try:
            if self._db is not None:
                self._require_same_file()
        except StoreError as error:
            problems.append(str(error))
        return tuple(problems)

    async def remove_damaged(self) -> Path | None:
        """Move all damaged rows to a file next to the tables; returns the file, or ``None`` without damaged rows."""
        try:
            kept = await asyncio.to_thread(table_file.remove_damaged_rows, self._path)
        except _SQLITE_ERRORS as error:
            raise self._explained(error) from error
        self._found = ()
        return kept

    def left_bytes(self) -> int | None:
        """Bytes that the file may still grow, including free space inside it; ``None``: no limit."""
        if not self._max_bytes:
            return None
        pages, free, size = [
            int(self._read(f"PRAGMA {name}")[0][0]) for name in ("page_count", "freelist_count", "page_size")
        ]
        return max(0, self._max_bytes - (pages - free) * size)

    async def close(self) -> None:
        if self._db is not None:
            self._db.close()
            self._db = None

    def _write_one(self, table: str, write: Write) -> Row:
        if write.kind == "delete":
            row_codec.check(write.row)
        data = b"" if write.kind == "delete" else row_codec.encode(write.row)
        self._prepare_write(table, (write,))
        return self._write(table, write, data)

    def _prepare_write(self, table: str, writes: Sequence[Write]) -> None:
        """Choose when the write must be on disk. A durable commit also writes all earlier ones."""
        level = _NORMAL
        for write in writes:
            if table not in RELAXED and is_durable(table, write.row.key):
                level = _FULL
                break
        if self._db is None:
            self._open()
        self._require_same_file()
        if level != self._synchronous:
            self._run(f"PRAGMA synchronous={level}")
            self._synchronous = level

    def _write(self, table: str, write: Write, data: bytes) -> Row:
        row = write.row
        place = RowKey(table, row.partition, row.key)
        if write.kind == "delete":
            cursor, written = self._run(_DELETE, (*place, row.etag)), row
        else:
            nonce = secrets.token_hex(table_file.NONCE_BYTES)
            etag = nonce + table_file.checksum(place, nonce, data)
            written = Row(row.partition, row.key, row.data, etag, row.schema)
            if write.kind == "replace":
                cursor = self._run(_REPLACE, (etag, data, *place, row.etag))
            else:
                try:
                    cursor = self._run(_CREATE, (*place, etag, data))
                except sqlite3.IntegrityError as error:
                    raise Conflict(f"{table}: '{row.key}' exists") from error
        if cursor.rowcount != 1:
            raise Conflict(f"{table}: '{row.key}' does not have the expected ETag")
        return written

    def _rollback(self) -> None:
        if self._db is not None and self._db.in_transaction:
            self._db.rollback()

    def _run(self, statement: str, values: tuple[Any, ...] = ()) -> sqlite3.Cursor:
        db = self._db or self._open()
        try:
            return db.execute(statement, values)
        except _SQLITE_ERRORS as error:
            raise self._explained(error) from error

    def _read(self, statement: str, values: tuple[Any, ...] = ()) -> list[Any]:
        db = self._db or self._open()
        self._require_same_file()
        try:
            return db.execute(statement, values).fetchall()
        except _SQLITE_ERRORS as error:
            raise self._explained(error) from error

    def _explained(self, error: Exception) -> Exception:
        """The error to raise instead."""
        if isinstance(error, sqlite3.IntegrityError):
            return error
        if isinstance(error, UnicodeEncodeError):
            return ValueError("partitions and keys are Unicode text without lone surrogates")
        return self._unusable(error)

    def _require_same_file(self) -> None:
        # Not split further, because it precedes each read and write.
        try:
            tables, log = os.stat(self._path), os.stat(self._log)  # noqa: PTH116
            files: tuple[int, int, int, int] | None = (tables.st_dev, tables.st_ino, log.st_dev, log.st_ino)
        except OSError:
            files = None  # one is missing
        self._files = self._files or files
        if files is None or files != self._files:
            raise StoreError(
                f"the tables in {self._path} were replaced or deleted while the server runs. Stop the server, restore "
                "a backup if necessary, and start it again."
            )

    def _open(self) -> sqlite3.Connection:
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            table_file.require_content(self._path)
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
            _prepare(db, self._path)
            if self._max_bytes:
                (size,) = db.execute("PRAGMA page_size").fetchone()
                db.execute(f"PRAGMA max_page_count={max(1, self._max_bytes // size)}")
        except (OSError, sqlite3.Error, UnicodeDecodeError) as error:
            db.close()
            raise self._unusable(error) from error
        except StoreError:
            db.close()
            raise
        self._db, self._synchronous = db, _NORMAL
        self._files = None
        self._require_same_file()
        return db

    def _unusable(self, error: Exception) -> StoreError:
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        if code == sqlite3.SQLITE_FULL:
            limit = f" of TELESCOPE_MAX_TABLES_MB ({self._max_bytes // 1_000_000} MB)" if self._max_bytes else ""
            return StoreFullError(
                f"the tables in {self._path} are full: the disk or the limit{limit} is reached. Free space."
            )
        if isinstance(error, sqlite3.OperationalError | OSError) and code not in _DAMAGED:
            return StoreError(f"the tables in {self._path} cannot be used: {error}. Check disk space and permissions.")
        return StoreError(
            f"the tables in {self._path} are damaged ({error}). Restore a backup, or move the file away to start with "
            "empty tables; no data were deleted."
        )


def _prepare(db: sqlite3.Connection, path: Path) -> None:
    """Set the journal mode and create the schema. SQLite's busy timeout does not cover these on a new file.

    Raises:
        StoreError: A newer version has written the file, or its table is missing.
    """
    end = time.monotonic() + BUSY_TIMEOUT_MS / 1000
    while True:
        try:
            db.execute("PRAGMA journal_mode=WAL")
            (version,) = db.execute("PRAGMA user_version").fetchone()
            if version > FORMAT:
                raise StoreError(
                    f"the tables in {path} have format {version}, but this version of Telescope knows only {FORMAT}. "
                    "Install the version that has written them, or restore an older backup."
                )
            if table_file.has_lost_commits(path):
                db.execute("BEGIN IMMEDIATE")
                if table_file.has_lost_commits(path):
                    _log.error("%s", table_file.keep_log(path))
                db.execute("COMMIT")
            db.execute("PRAGMA synchronous=NORMAL")
            if version < FORMAT:
                db.execute(_SCHEMA)
                db.execute(f"PRAGMA user_version={FORMAT}")
            db.execute("SELECT 1 FROM rows LIMIT 1")
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY or time.monotonic() > end:
                raise
            time.sleep(_PAUSE_S)
        else:
            return
