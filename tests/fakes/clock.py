"""Wall clocks that tests can advance."""

import time


class MovingClock:
    """The system clock plus an offset that tests increase."""

    def __init__(self) -> None:
        self.ahead_ms = 0.0

    def now_ms(self) -> int:
        return time.time_ns() // 1_000_000 + int(self.ahead_ms)

    def advance(self, seconds: float) -> None:
        self.ahead_ms += 1000 * seconds


class MemoryClock(MovingClock):
    """Advanced by tests, by 1 ms with each call of a ``Cloud``, and by waits on a ``VirtualTimeLoop``."""

    def __init__(self) -> None:
        super().__init__()
        self._start_ms = time.time_ns() // 1_000_000

    def now_ms(self) -> int:
        return self._start_ms + int(self.ahead_ms)
