"""Streams and cameras of a room device that are not well though its driver raises no error: silent, or stuck.

It is asked from another thread than the one that reads: a driver that never comes back from a reading is silent too.
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
"""A source that is read less often than it is to be heard is silent when so many of its readings are missing."""
_LIKE = 10
"""So many readings without any difference are needed, however long they take: two of them may be alike by chance."""


@dataclass(slots=True)
class _Heard:
    """What a source gave last, since when it is the same [s], how often in a row, and when the newest came [s]."""

    content: object = None
    same_since_s: float = 0.0
    times: int = 0
    at_s: float = 0.0


class StreamWatchdog:
    """Watches over the sources of one device. Thread-safe.

    Args:
        watches: What the room's manifest says of them.
        rate_hz: How often a source is read now [Hz].
        clock_s: Monotonic clock [s].
    """

    def __init__(
        self,
        watches: Sequence[Watch],
        rate_hz: Callable[[str], float],
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._watches = tuple(watches)
        self._rate_hz = rate_hz
        self._clock_s = clock_s
        self._lock = threading.Lock()
        self._heard: dict[str, _Heard] = {}
        self._open: dict[str, Fault] = {}

    def begin(self) -> None:
        """The device is there, or there again: its sources are expected from now on."""
        now_s = self._clock_s()
        with self._lock:
            self._heard = {watch.source: _Heard(at_s=now_s) for watch in self._watches}

    def note(self, source: str, content: object) -> None:
        """A source gave this: its values, or a picture's bytes."""
        now_s = self._clock_s()
        with self._lock:
            heard = self._heard.get(source)
            if heard is None:
                return
            heard.at_s = now_s
            if heard.times and heard.content == content:
                heard.times += 1
            else:
                heard.content, heard.same_since_s, heard.times = content, now_s, 1

    def faults(self) -> tuple[Fault, ...]:
        """What is wrong now; one that goes on keeps its words and the time when it was found."""
        now_s = self._clock_s()
        with self._lock:
            wrong = {f"{what}.{source}": message for what, source, message in self._wrong(now_s)}
            self._open = {
                code: self._open.get(code) or Fault(code=code, message=message, since_ms=wall_ms())
                for code, message in wrong.items()
            }
            return tuple(self._open.values())

    def _wrong(self, now_s: float) -> list[tuple[str, str, str]]:
        found = []
        for watch in self._watches:
            heard = self._heard.get(watch.source)
            if heard is None:
                continue
            gap_s = _PERIODS / self._rate_hz(watch.source)
            if watch.silent_s is not None and now_s - heard.at_s > max(watch.silent_s, gap_s):
                message = (
                    f"'{watch.source}' has given nothing for {watch.silent_s:g} s. See that the device has power and "
                    "is connected; once it is heard again this clears by itself."
                )
                found.append((SILENT, watch.source, message))
            elif watch.stuck_s is not None and heard.times >= _LIKE and heard.at_s - heard.same_since_s > watch.stuck_s:
                message = (
                    f"'{watch.source}' has been exactly the same for {watch.stuck_s:g} s, as nothing measured is. "
                    "Do not go by it; switch the device off and on, and have it replaced if that does not help."
                )
                found.append((STUCK, watch.source, message))
        return found
