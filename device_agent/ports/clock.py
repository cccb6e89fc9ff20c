"""The agent's clocks: its own monotonic one, which decides, and an estimate of the cloud's, for ``ttl_ms``."""

import threading
import time

_DRIFT = 50e-6
"""Assumed most by which two clocks drift apart, 50 ppm: an old estimate's error grows by it."""


def tick_ms() -> int:
    """The agent's monotonic clock [ms]."""
    return time.monotonic_ns() // 1_000_000


def wall_ms() -> int:
    """The agent's wall clock [ms since 1970, UTC]; to show and to store, never to decide."""
    return time.time_ns() // 1_000_000


class CloudClock:
    """The cloud's wall clock, as seen from the agent's monotonic clock. Thread-safe.

    Each HTTP answer carries the server's time; half the round trip bounds the error, and the estimate with the
    smallest bound wins. The agent's own wall clock is never asked, so setting it changes nothing.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._offset_ms = 0.0
        self._error_ms = float("inf")
        self._measured_ms = 0

    def observe(self, *, server_ms: int, sent_tick_ms: float, received_tick_ms: float) -> None:
        """Take in one exchange: request sent, answer received [own ticks], and the server's time in it."""
        error = max(0.5, (received_tick_ms - sent_tick_ms) / 2)
        offset = server_ms - (sent_tick_ms + received_tick_ms) / 2
        with self._lock:
            aged = self._error_ms + (received_tick_ms - self._measured_ms) * _DRIFT
            if error <= aged:
                self._offset_ms, self._error_ms, self._measured_ms = offset, error, int(received_tick_ms)

    def now_ms(self) -> float | None:
        """The cloud's time [ms since 1970], or ``None`` before the first exchange."""
        with self._lock:
            return None if self._error_ms == float("inf") else tick_ms() + self._offset_ms
