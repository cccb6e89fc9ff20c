"""Records the control periods and started actions that the benchmark's agent reports."""

import contextlib
import socket
import threading
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from tests.faults.judge import Row

_CAPACITY = 4000
"""Number of periods in half a minute."""


class Period(NamedTuple):
    """One period of a control loop.

    Attributes:
        at_ms: Time on the monotonic clock of the machine.
        moved_rad: Commanded motion of the fastest joint in this period.
    """

    at_ms: float
    mode: str
    moved_rad: float
    epoch: int
    sequence: int


class Recorder:
    """Receives reports until it is closed.

    Attributes:
        starts: Action → number of starts; 1 is correct.
    """

    def __init__(self, path: Path) -> None:
        self.starts: Counter[str] = Counter()
        self._periods: dict[str, list[Period]] = {}
        self._lock = threading.Lock()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self._socket.bind(str(path))
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        with contextlib.suppress(OSError):
            while words := self._socket.recv(400).decode().split():
                with self._lock:
                    self._record(words)

    def _record(self, words: list[str]) -> None:
        if words[0] == "started":
            self.starts[words[2]] += 1
            return
        _, name, at_ms, mode, moved, epoch, sequence = words
        periods = self._periods.setdefault(name, [])
        periods.append(Period(float(at_ms), mode, float(moved), int(epoch), int(sequence)))
        if len(periods) > 2 * _CAPACITY:
            del periods[:_CAPACITY]

    def since(self, name: str, at_ms: float) -> list[Period]:
        """Returns the periods of one device since a time."""
        with self._lock:
            return [each for each in self._periods.get(name, ()) if each.at_ms >= at_ms]

    def rows(self, name: str, since_ms: float) -> list[Row]:
        """Returns the same as trace rows: one joint with the accumulated motion."""
        total_rad, rows = 0.0, []
        for each in self.since(name, since_ms):
            total_rad += each.moved_rad
            rows.append(Row(each.at_ms, (total_rad,)))
        return rows

    def close(self) -> None:
        """Stops receiving."""
        self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._socket.close()
