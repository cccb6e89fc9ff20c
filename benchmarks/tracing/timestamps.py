"""Moments in other programs of this machine, by the one clock that all its processes share (``CLOCK_MONOTONIC``).

Whoever measures opens ``TimestampReceiver`` and names its port in ``TELESCOPE_BENCH_MARKS``; a program that was started by
``benchmarks.tracing.traced_programs`` tells it what happens. A mark goes as a datagram on loopback: it is there when the sender's next
line runs, and costs some ten microseconds.
"""

import os
import select
import socket
import time
from typing import Final, NamedTuple, Self

from benchmarks.baseline.echo_servers import HOST

VARIABLE: Final = "TELESCOPE_BENCH_MARKS"
_MOST_BYTES: Final = 200


class Timestamp(NamedTuple):
    """Something happened."""

    name: str
    at_ns: int


class TimestampReceiver:
    """Hears marks. ``with`` closes it."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((HOST, 0))
        self._socket.setblocking(False)
        self.settings: dict[str, str] = {VARIABLE: str(self._socket.getsockname()[1])}
        """For the environment of the program that is to tell."""

    def drain(self) -> list[Timestamp]:
        """All that were told since the last call, in the order of their times."""
        found: list[Timestamp] = []
        while True:
            try:
                name, at_ns = self._socket.recv(_MOST_BYTES).decode().split()
            except BlockingIOError:
                return sorted(found, key=lambda mark: mark.at_ns)
            found.append(Timestamp(name, int(at_ns)))

    def until(self, name: str, *, since_ns: int, within_s: float) -> list[Timestamp]:
        """Wait for this one; all that were told from then on.

        Raises:
            TimeoutError: It is not told.
        """
        found: list[Timestamp] = []
        deadline_s = time.monotonic() + within_s
        while not any(mark.name == name for mark in found):
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                raise TimeoutError(f"no mark '{name}' in {within_s:g} s, only {', '.join(mark.name for mark in found)}")
            select.select([self._socket], [], [], left_s)
            found += [mark for mark in self.drain() if mark.at_ns >= since_ns]
        return sorted(found, key=lambda mark: mark.at_ns)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()


class TimestampSender:
    """Tells marks to who listens at the port in the environment."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((HOST, int(os.environ[VARIABLE])))

    def tell(self, name: str) -> None:
        """Now."""
        self._socket.send(f"{name} {time.monotonic_ns()}".encode())

    def close(self) -> None:
        """Let go."""
        self._socket.close()
