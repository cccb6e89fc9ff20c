"""Shows whether programs of the server use an installation's folder.

SQLite's locks are portable and end with their process.
"""

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path

LOCK = "server.lock"


class InUse(Exception):  # noqa: N818 (an outcome that callers expect)
    """Another program uses the folder."""


@contextlib.contextmanager
def in_use(home: Path) -> Iterator[None]:
    """Mark the folder as used. Several programs may use it.

    Raises:
        InUse: A backup is being restored.
        OSError: The folder cannot be written.
    """
    home.mkdir(parents=True, exist_ok=True, mode=0o700)
    with _locked(home, "BEGIN", "SELECT count(*) FROM sqlite_schema"):
        yield


@contextlib.contextmanager
def exclusive(home: Path) -> Iterator[None]:
    """Prevent that a program of the server starts.

    Raises:
        InUse: A program of the server uses the folder.
        OSError: The folder cannot be written.
    """
    with _locked(home, "BEGIN EXCLUSIVE"):
        yield


@contextlib.contextmanager
def _locked(home: Path, *statements: str) -> Iterator[None]:
    with contextlib.closing(sqlite3.connect(home / LOCK, timeout=0.5, isolation_level=None)) as lock:
        try:
            for statement in statements:
                lock.execute(statement).fetchall()
        except sqlite3.Error as error:
            if error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY:
                raise InUse(str(home)) from error
            raise OSError(f"{home / LOCK}: {error}") from error
        yield
