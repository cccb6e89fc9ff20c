"""Wall clocks that a test can advance."""

import time


class MovingClock:
    """The machine's clock, plus what a test has advanced it by."""

    def __init__(self) -> None:
        self.ahead_ms = 0.0

    def now_ms(self) -> int:
        return time.time_ns() // 1_000_000 + int(self.ahead_ms)

    def advance(self, seconds: float) -> None:
        self.ahead_ms += 1000 * seconds


class MemoryClock(MovingClock):
    """Moves when a test advances it, by 1 ms with each call of a ``Cloud``, and by waits on a ``VirtualTimeLoop``."""

    def __init__(self) -> None:
        super().__init__()
        self._start_ms = time.time_ns() // 1_000_000

    def now_ms(self) -> int:
        return self._start_ms + int(self.ahead_ms)
