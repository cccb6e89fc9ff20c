"""Detects damage of the SQLite file of ``SqliteTables``: flipped bytes, lost commits, and a replaced file.

SQLite ignores the rest of its write-ahead log after the first damaged frame, without an error. The log is therefore
compared with what SQLite has read from it. Each row contains a checksum, because SQLite has none for its pages.
"""

import contextlib
import json
import os
import shutil
import sqlite3
import struct
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec

from function_app.adapters.shared import row_codec
from function_app.ports.tables import Row, StoreError

FILE_NAME: Final = "tables.sqlite"
"""Name of the file in an installation's folder."""
NONCE_BYTES: Final = 8
"""Random bytes at the beginning of an ETag, in hexadecimal."""
_NONCE_LENGTH: Final = 2 * NONCE_BYTES
_ETAG_LENGTH: Final = 24
_WAL_HEADER: Final = struct.Struct(">8I")
_FRAME_HEADER: Final = struct.Struct(">6I")
_WAL_MAGIC: Final = 0x377F0682
_BIG_ENDIAN: Final = 1
_SUMMED: Final = 24
"""Bytes of the log's header that its checksum covers."""
_SUMMED_IN_FRAME: Final = 8
_MASK: Final = 0xFFFFFFFF
_MAX_SHOWN: Final = 5
_BYTES: Final = "surrogateescape"
"""Keeps bytes that are not UTF-8."""
_RAW: Final = "{} rows WHERE CAST(tab AS BLOB)=? AND CAST(part AS BLOB)=? AND CAST(key AS BLOB)=?"


class RowKey(NamedTuple):
    """The place of a row."""

    table: str
    partition: str
    key: str


class DamagedRowError(StoreError):
    """The content of a row differs from what was written."""

    def __init__(self, place: RowKey) -> None:
        super().__init__(
            f"the row {place.key!r} of {place.partition!r} in {place.table!r} is damaged. Restore a backup, or run "
            "`telescope-server verify --remove-damaged`."
        )


def decode(place: RowKey, etag: Any, data: Any) -> Row:
    """A stored row. Rows of earlier versions have no checksum.

    Raises:
        DamagedRowError: The data or the ETag differ from what was written.
    """
    content = data.encode() if isinstance(data, str) else data
    if isinstance(etag, str) and isinstance(content, bytes):
        nonce = etag[:_NONCE_LENGTH]
        if etag == nonce or etag == nonce + checksum(place, nonce, content):
            with contextlib.suppress(msgspec.DecodeError):
                return row_codec.decode(place.partition, place.key, content, etag)
    raise DamagedRowError(place)


def checksum(place: RowKey, nonce: str, data: bytes) -> str:
    """The checksum of a row, which follows the nonce in its ETag: eight hexadecimal digits."""
    return f"{zlib.crc32(data, zlib.crc32(chr(0).join((*place, nonce)).encode(errors=_BYTES))):08x}"


def log_of(path: Path) -> Path:
    """The write-ahead log of a database."""
    return path.with_name(f"{path.name}-wal")


def require_content(path: Path) -> None:
    """SQLite deletes the log of an empty file when it opens the file.

    Raises:
        StoreError: The file is missing or empty, but its log exists.
    """
    log = log_of(path)
    if log.exists() and log.stat().st_size and not (path.exists() and path.stat().st_size):
        raise StoreError(
            f"the tables in {path} are missing or empty, but their log exists. Restore a backup, or move {log.name} "
            "away to start with empty tables."
        )


def has_lost_commits(path: Path) -> bool:
    """Whether the log contains commits behind a damaged frame, which SQLite ignores. Exact only with the write lock.

    Reads the log only: if a process closes another file of an open database, it loses SQLite's locks on that file.
    """
    try:
        with log_of(path).open("rb") as log:
            header = log.read(_WAL_HEADER.size)
            if len(header) < _WAL_HEADER.size:
                return False
            magic, _, page_size, _, *salt, first, second = _WAL_HEADER.unpack(header)
            order = ">" if magic & _BIG_ENDIAN else "<"
            sums = _sums(order, (0, 0), header[:_SUMMED])
            if magic & ~_BIG_ENDIAN != _WAL_MAGIC or sums != (first, second):
                return bool(log.read(1))
            intact = True
            while len(frame := log.read(_FRAME_HEADER.size + page_size)) == _FRAME_HEADER.size + page_size:
                _, size_after_commit, *frame_salt, first, second = _FRAME_HEADER.unpack_from(frame)
                if intact:
                    sums = _sums(order, sums, frame[:_SUMMED_IN_FRAME] + frame[_FRAME_HEADER.size :])
                    intact = frame_salt == salt and sums == (first, second)
                if not intact and frame_salt == salt and size_after_commit:
                    return True
    except FileNotFoundError:
        pass
    return False


def _sums(order: str, sums: tuple[int, ...], content: bytes) -> tuple[int, int]:
    """SQLite's checksum of ``content``, continued from ``sums``."""
    first, second = sums
    words = struct.unpack(f"{order}{len(content) // 4}I", content)
    for index in range(0, len(words), 2):
        first = (first + words[index] + second) & _MASK
        second = (second + words[index + 1] + first) & _MASK
    return first, second


def keep_log(path: Path) -> str:
    """Copy the damaged log before SQLite overwrites it; returns a report."""
    copy = path.with_name(f"{path.name}.damaged-log-{time.time_ns() // 1_000_000}")
    shutil.copyfile(log_of(path), copy)
    copy.chmod(0o600)
    return _lost_log(copy.name)


def kept_files(path: Path) -> list[str]:
    """A report of each file that was kept because data were lost."""
    prefix = f"{path.name}.damaged-log-"
    with contextlib.suppress(FileNotFoundError), os.scandir(path.parent) as entries:
        return [_lost_log(name) for name in sorted(entry.name for entry in entries) if name.startswith(prefix)]
    return []


def _lost_log(name: str) -> str:
    return (
        f"the log of the tables ended with writes that cannot be read; it is kept as {name}. They were lost, or a "
        "process was killed during its last write. Check recent changes of accounts and shares, or restore a backup; "
        "then delete this file."
    )


def damage(path: Path) -> Iterator[str]:
    """Every sign of damage in the file, for people. Reads all of it."""
    try:
        with contextlib.closing(_opened(path)) as database:
            for (text,) in database.execute(f"PRAGMA quick_check({_MAX_SHOWN})"):
                if text != "ok":
                    yield f"the tables in {path.name} are damaged: {text!a}. Restore a backup."
            places = list(_damaged_rows(database))
    except (sqlite3.Error, UnicodeDecodeError) as error:  # SQLite's message may quote damaged text
        yield f"the tables in {path.name} cannot be read completely: {error}. Restore a backup."
        return
    except StoreError as error:
        yield str(error)
        return
    for place in places[:_MAX_SHOWN]:
        yield str(DamagedRowError(place))
    if len(places) > _MAX_SHOWN:
        yield f"{len(places) - _MAX_SHOWN} more rows are damaged."


def partitions(path: Path, table: str) -> list[str]:
    """The partitions of a table."""
    with contextlib.closing(_opened(path)) as database:
        return [part for (part,) in database.execute("SELECT DISTINCT part FROM rows WHERE tab=?", (table,))]


def remove_damaged_rows(path: Path) -> Path | None:
    """Move the damaged rows to a file next to the tables, one JSON array in a line; returns it if there are any."""
    with contextlib.closing(_opened(path)) as database:
        places = list(_damaged_rows(database))
        if not places:
            return None
        kept = path.with_name(f"{path.name}.damaged-rows-{time.time_ns() // 1_000_000}")
        with os.fdopen(os.open(kept, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "w") as file:
            for place in places:
                values = [text.encode(errors=_BYTES) for text in place]
                for row in database.execute(_RAW.format("SELECT etag, data FROM"), values):
                    file.write(json.dumps([str(value) for value in (*place, *row)]) + "\n")
                database.execute(_RAW.format("DELETE FROM"), values)
            file.flush()
            os.fsync(file.fileno())
    return kept


def _damaged_rows(database: sqlite3.Connection) -> Iterator[RowKey]:
    """Rows whose content or position differs from what was written."""
    previous: tuple[bytes, ...] = ()
    for table, partition, key, etag, data in database.execute("SELECT tab, part, key, etag, data FROM rows"):
        place = RowKey(str(table), str(partition), str(key))
        order = tuple(text.encode(errors=_BYTES) for text in place)
        try:
            decode(place, etag, data)
        except DamagedRowError:
            yield place
        else:
            if order <= previous:
                yield place
            previous = order


def _opened(path: Path) -> sqlite3.Connection:
    """A connection that reads damaged text, too. Raises ``StoreError`` as ``require_content`` does."""
    require_content(path)
    database = sqlite3.connect(path, isolation_level=None)
    database.text_factory = lambda text: text.decode(errors=_BYTES)
    return database
