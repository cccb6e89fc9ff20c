"""``python -m benchmarks.faults.launcher MODULE ARGUMENT…``: a program of the product with faults inside its process.

SIGUSR1 applies the faults in ``$TELESCOPE_HOME/faults-PROCESS.json`` (``ProcessFaults``): another wall clock, and
tables that cannot be written. With ``TELESCOPE_PERSISTENCE=1`` mosquitto stores sessions and messages. The product has
no such code.
"""

import os
import runpy
import signal
import sqlite3
import sys
import time
import weakref
from datetime import datetime, timedelta, tzinfo
from pathlib import Path
from typing import Any, Final, Self

import jwt.api_jwt
import msgspec

from infra.mosquitto import configuration

PERSISTENCE: Final = "TELESCOPE_PERSISTENCE"


def faults_file(home: Path, process: int) -> Path:
    """Returns the file with the faults of a process."""
    return home / f"faults-{process}.json"


class ProcessFaults(msgspec.Struct, frozen=True):
    """Faults of one process.

    Attributes:
        clock_s: Difference of its wall clock [s].
        read_only: SQLite rejects writes, as in a file that cannot be written.
    """

    clock_s: float = 0.0
    read_only: bool = False


class _Faults:
    """Applies the faults of the file at each signal."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._faults = ProcessFaults()
        self._databases: weakref.WeakSet[sqlite3.Connection] = weakref.WeakSet()

    def install(self) -> None:
        seconds, nanoseconds = time.time, time.time_ns
        time.time = lambda: seconds() + self._faults.clock_s
        time.time_ns = lambda: nanoseconds() + round(self._faults.clock_s * 1e9)
        faults, databases = self, self._databases

        class ShiftedDatetime(datetime):
            """The type from which PyJWT reads the time."""

            @classmethod
            def now(cls, tz: tzinfo | None = None) -> Self:
                return super().now(tz) + timedelta(seconds=faults._faults.clock_s)

        jwt.api_jwt.datetime = ShiftedDatetime  # type: ignore[attr-defined]
        connect = sqlite3.connect

        def connected(*arguments: Any, **options: Any) -> sqlite3.Connection:
            database = connect(*arguments, factory=_Database, **options)
            databases.add(database)
            self._apply(database)
            return database

        sqlite3.connect = connected  # type: ignore[assignment]
        signal.signal(signal.SIGUSR1, self._read)

    def _read(self, *_: object) -> None:
        self._faults = msgspec.json.decode(self._file.read_bytes(), type=ProcessFaults)
        for database in list(self._databases):
            self._apply(database)

    def _apply(self, database: sqlite3.Connection) -> None:
        try:
            database.execute(f"PRAGMA query_only={int(self._faults.read_only)}")
        except sqlite3.ProgrammingError:  # closed, or of another thread
            return


class _Database(sqlite3.Connection):
    """A connection with weak references."""


def _store_messages() -> None:
    """Let mosquitto store sessions and messages each second."""
    create = configuration.configuration

    def persistent(**options: Any) -> str:
        return create(**options).replace("persistence false", "persistence true\nautosave_interval 1")

    configuration.configuration = persistent


if __name__ == "__main__":
    _Faults(faults_file(Path(os.environ["TELESCOPE_HOME"]), os.getpid())).install()
    if os.environ.get(PERSISTENCE):
        _store_messages()
    sys.argv = sys.argv[1:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
