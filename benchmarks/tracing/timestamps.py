"""Timestamps of events in other processes of this machine, on their common clock (``CLOCK_MONOTONIC``).

A benchmark opens a ``TimestampReceiver`` and passes its port in ``TELESCOPE_BENCH_MARKS``. Programs started by
``benchmarks.tracing.traced_programs`` send a datagram on loopback per event, which costs about ten microseconds.
"""

import os
import select
import socket
import time
from typing import Final, NamedTuple, Self

from benchmarks.baseline.echo_servers import HOST

VARIABLE: Final = "TELESCOPE_BENCH_MARKS"
_MAX_BYTES: Final = 200


class Timestamp(NamedTuple):
    """One event and its time."""

    name: str
    at_ns: int


class TimestampReceiver:
    """Receives timestamps. Leaving the context closes the socket."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((HOST, 0))
        self._socket.setblocking(False)
        self.settings: dict[str, str] = {VARIABLE: str(self._socket.getsockname()[1])}
        """Environment variables for the traced program."""

    def drain(self) -> list[Timestamp]:
        """Returns the timestamps received since the last call, ordered by time."""
        timestamps: list[Timestamp] = []
        while True:
            try:
                name, at_ns = self._socket.recv(_MAX_BYTES).decode().split()
            except BlockingIOError:
                return sorted(timestamps, key=lambda mark: mark.at_ns)
            timestamps.append(Timestamp(name, int(at_ns)))

    def until(self, name: str, *, since_ns: int, within_s: float) -> list[Timestamp]:
        """Waits for an event and returns all timestamps from then on.

        Raises:
            TimeoutError: The event did not occur in time.
        """
        timestamps: list[Timestamp] = []
        deadline_s = time.monotonic() + within_s
        while not any(mark.name == name for mark in timestamps):
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0:
                raise TimeoutError(
                    f"no timestamp '{name}' in {within_s:g} s, only {', '.join(mark.name for mark in timestamps)}"
                )
            select.select([self._socket], [], [], remaining_s)
            timestamps += [mark for mark in self.drain() if mark.at_ns >= since_ns]
        return sorted(timestamps, key=lambda mark: mark.at_ns)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()


class TimestampSender:
    """Sends timestamps to the port in the environment variable."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((HOST, int(os.environ[VARIABLE])))

    def send(self, name: str) -> None:
        """Sends an event with the current time."""
        self._socket.send(f"{name} {time.monotonic_ns()}".encode())

    def close(self) -> None:
        """Closes the socket."""
        self._socket.close()
