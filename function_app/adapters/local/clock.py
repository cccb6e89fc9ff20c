"""The machine's wall clock."""

import time


class SystemClock:
    """``Clock`` of the operating system."""

    def now_ms(self) -> int:
        return time.time_ns() // 1_000_000
