"""The agent's clocks: the monotonic clock for decisions, and an estimate of the cloud's clock for ``ttl_ms``."""

import threading
import time

_DRIFT = 50e-6
"""Assumed maximum drift between two clocks, 50 ppm; the error bound of an estimate grows by it."""


def tick_ms() -> int:
    """The agent's monotonic clock [ms]."""
    return time.monotonic_ns() // 1_000_000


def wall_ms() -> int:
    """The agent's wall clock [ms since 1970, UTC]; for display and storage only."""
    return time.time_ns() // 1_000_000


class CloudClock:
    """The cloud's wall clock, estimated on the agent's monotonic clock. Thread-safe.

    Each HTTP response contains the server's time. Half the round trip bounds the error, and the estimate with the
    smallest bound is used. An exchange that contradicts the estimate replaces it: the cloud's clock was set. Changes of
    the agent's own wall clock have no effect.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._offset_ms = 0.0
        self._error_ms = float("inf")
        self._measured_ms = 0

    def observe(self, *, server_ms: int, sent_tick_ms: float, received_tick_ms: float) -> None:
        """Update the estimate with one exchange: times of request and response [own ticks], and the server's time."""
        error = max(0.5, (received_tick_ms - sent_tick_ms) / 2)
        offset = server_ms - (sent_tick_ms + received_tick_ms) / 2
        with self._lock:
            aged = self._error_ms + (received_tick_ms - self._measured_ms) * _DRIFT
            if error <= aged or abs(offset - self._offset_ms) > error + aged:
                self._offset_ms, self._error_ms, self._measured_ms = offset, error, int(received_tick_ms)

    def now_ms(self) -> float | None:
        """The cloud's time [ms since 1970], or ``None`` before the first exchange."""
        with self._lock:
            return None if self._error_ms == float("inf") else tick_ms() + self._offset_ms
