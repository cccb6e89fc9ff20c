"""Load governor: reduces work of the agent when control periods start late, in a fixed order, never control itself.

One governor serves all devices of an agent. Each control loop reports when its periods start. If too many are late,
the level rises by one; after a time without late periods it falls by one:

| level | reduced |
| --- | --- |
| 1 | frames of cameras, to a quarter |
| 2 | also the samples of perception, to a half |
| 3 | also telemetry, to a half; never the telemetry that answers setpoints |
"""

import logging
import threading
from collections.abc import Mapping
from typing import Literal

Work = Literal["cameras", "perception", "telemetry"]
REDUCTIONS: Mapping[Work, tuple[int, float]] = {"cameras": (1, 0.25), "perception": (2, 0.5), "telemetry": (3, 0.5)}
"""Work → the level from which it is reduced, and the remaining share of its rate."""
MAX_LEVEL = 3
WINDOW_S = 1.0
"""Time over which late periods are counted [s]."""
MIN_PERIODS = 10
"""Fewer periods in a window decide nothing."""
LATE_SHARE = 0.1
"""The level rises when at least this share of the periods is late."""
CALM_S = 10.0
"""Time without a late window after which the level falls [s]."""
_log = logging.getLogger(__name__)


class LoadGovernor:
    """Decides which work is reduced. Thread-safe; all times are of one monotonic clock [s]."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._level = 0
        self._window_s = 0.0
        self._periods = 0
        self._late = 0
        self._changed_s = 0.0

    @property
    def level(self) -> int:
        """0: nothing is reduced; 3: everything that can be."""
        return self._level

    def share(self, work: Work) -> float:
        """The share of its rate at which this work runs now."""
        level, share = REDUCTIONS[work]
        return share if self._level >= level else 1.0

    def record_period(self, now_s: float, *, late_s: float, period_s: float) -> None:
        """Record the start of a control period.

        Args:
            now_s: Its start [s].
            late_s: By how much it is late [s].
            period_s: Its length [s]. A period is late if it starts a whole length too late.
        """
        with self._lock:
            self._periods += 1
            self._late += late_s >= period_s
            if now_s - self._window_s < WINDOW_S:
                return
            share = self._late / self._periods if self._periods >= MIN_PERIODS else 0.0
            self._window_s, self._periods, self._late = now_s, 0, 0
            if share >= LATE_SHARE:
                self._change(now_s, self._level + 1, share)
            elif now_s - self._changed_s >= CALM_S:
                self._change(now_s, self._level - 1, share)

    def _change(self, now_s: float, level: int, share: float) -> None:
        previous, self._level = self._level, min(MAX_LEVEL, max(0, level))
        self._changed_s = now_s
        if self._level != previous:
            reduced = ", ".join(work for work in REDUCTIONS if self.share(work) < 1) or "nothing"
            _log.warning(
                "load level %d (%.0f %% of control periods late): reduced: %s", self._level, share * 100, reduced
            )
