"""Limits log lines that clients cause: a client whose publish is rejected may reconnect and try again without end."""

import logging
import math
import time
from collections import OrderedDict
from collections.abc import Callable

REPEAT_S = 60.0
"""The same line appears once in this time [s]."""
_LINES_PER_S = 20
_BURST = 400
_REMEMBERED = 1_000


class RepeatFilter(logging.Filter):
    """Passes equal lines once per minute, with the number of omitted ones, and at most 20 lines per second."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._now_s = now_s
        self._lines: OrderedDict[str, tuple[float, int]] = OrderedDict()
        self._budget = float(_BURST)
        self._refilled_s = now_s()

    def filter(self, record: logging.LogRecord) -> bool:
        """See ``logging.Filter``."""
        now_s, line = self._now_s(), record.getMessage()
        shown_s, omitted = self._lines.get(line, (-math.inf, 0))
        self._budget = min(_BURST, self._budget + (now_s - self._refilled_s) * _LINES_PER_S)
        self._refilled_s = now_s
        shown = now_s - shown_s >= REPEAT_S and self._budget >= 1
        if shown:
            self._budget -= 1
            if omitted:
                record.msg, record.args = "%s (omitted %d times before)", (line, omitted)
        self._lines[line] = (now_s, 0) if shown else (shown_s, omitted + 1)
        self._lines.move_to_end(line)
        if len(self._lines) > _REMEMBERED:
            self._lines.popitem(last=False)
        return shown
