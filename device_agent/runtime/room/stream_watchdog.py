"""Stream watchdog: reports silent or stuck streams and cameras of a room device whose driver raises no error.

It runs in another thread than the reads, so that it also detects a driver that blocks in a read.
"""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from device_agent.ports.clock import wall_ms
from device_agent.protocol import Fault
from device_agent.protocol.manifests.room import Watch

SILENT, STUCK = "silent", "stuck"
_PERIODS = 3.0
"""A source with a low rate is silent if this many readings are missing."""
_MIN_EQUAL = 10
"""Minimum number of equal readings of a stuck source: a few may be equal by chance."""


@dataclass(slots=True)
class _SourceState:
    """Last content of a source, start of the equal readings [s], their number, and time of the newest one [s]."""

    content: object = None
    equal_since_s: float = 0.0
    equal_count: int = 0
    received_s: float = 0.0


class StreamWatchdog:
    """Watchdog of one device's sources. Thread-safe."""

    def __init__(
        self, watches: Sequence[Watch], rate_hz: Callable[[str], float], clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._watches = tuple(watches)
        self._rate_hz = rate_hz
        self._clock_s = clock_s
        self._lock = threading.Lock()
        self._sources: dict[str, _SourceState] = {}
        self._open: dict[str, Fault] = {}

    def reset(self) -> None:
        """Expect readings from now on: the device has connected."""
        now_s = self._clock_s()
        with self._lock:
            self._sources = {watch.source: _SourceState(received_s=now_s) for watch in self._watches}

    def record(self, source: str, content: object) -> None:
        """Record a reading: the values of a stream, or the bytes of a picture."""
        now_s = self._clock_s()
        with self._lock:
            state = self._sources.get(source)
            if state is None:
                return
            state.received_s = now_s
            if state.equal_count and state.content == content:
                state.equal_count += 1
            else:
                state.content, state.equal_since_s, state.equal_count = content, now_s, 1

    def faults(self) -> tuple[Fault, ...]:
        """Present faults; a continuing fault keeps its message and the time of its detection."""
        now_s = self._clock_s()
        with self._lock:
            messages = {f"{kind}.{source}": message for kind, source, message in self._check(now_s)}
            self._open = {
                code: self._open.get(code) or Fault(code=code, message=message, since_ms=wall_ms())
                for code, message in messages.items()
            }
            return tuple(self._open.values())

    def _check(self, now_s: float) -> list[tuple[str, str, str]]:
        faults = []
        for watch in self._watches:
            state = self._sources.get(watch.source)
            if state is None:
                continue
            gap_s = _PERIODS / self._rate_hz(watch.source)
            if watch.silent_s is not None and now_s - state.received_s > max(watch.silent_s, gap_s):
                message = (
                    f"'{watch.source}' has sent nothing for {watch.silent_s:g} s. Check that the device has power and "
                    "is connected; the fault clears with the next reading."
                )
                faults.append((SILENT, watch.source, message))
            elif watch.stuck_s is not None and _equal_s(state) > watch.stuck_s:
                message = (
                    f"'{watch.source}' has not changed at all for {watch.stuck_s:g} s, so it is probably defective. "
                    "Do not rely on it; restart the device, and replace it if the fault remains."
                )
                faults.append((STUCK, watch.source, message))
        return faults


def _equal_s(state: _SourceState) -> float:
    return state.received_s - state.equal_since_s if state.equal_count >= _MIN_EQUAL else 0.0
