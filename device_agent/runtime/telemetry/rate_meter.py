"""Measures at which rate messages of each stream are published."""

from collections import deque
from collections.abc import Mapping

WINDOW_S = 5.0
"""Time over which a rate is measured [s]."""
_MAX_TIMES = 512
"""More than a window of the fastest stream."""


class RateMeter:
    """Published messages by name. ``record`` may be called by one thread for each name. Times are monotonic [s]."""

    def __init__(self) -> None:
        self._times_s: dict[str, deque[float]] = {}
        self._since_s: dict[str, float] = {}

    def record(self, name: str, now_s: float) -> None:
        """Record one message."""
        times_s = self._times_s.get(name)
        if times_s is None:
            self._since_s[name] = now_s
            times_s = self._times_s.setdefault(name, deque(maxlen=_MAX_TIMES))
        times_s.append(now_s)

    def rates_hz(self, now_s: float) -> Mapping[str, float]:
        """The rate of each name that was measured for a whole window [Hz]."""
        return {
            name: round(sum(time_s > now_s - WINDOW_S for time_s in tuple(times_s)) / WINDOW_S, 1)
            for name, times_s in tuple(self._times_s.items())
            if now_s - self._since_s[name] >= WINDOW_S
        }
