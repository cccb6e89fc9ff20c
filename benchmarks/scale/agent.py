"""The agent with the additional driver ``light`` and an observer of its control loops.

``python -m benchmarks.scale.agent RATE_HZ -- …`` passes the remaining arguments to ``device_agent``. For each line
with a number of seconds on standard input it observes for that time and prints ``statistics`` and ``LoopStatistics``.
"""

import sys
import threading
import time
from collections.abc import Sequence
from typing import Any, Final

import msgspec

from benchmarks.reporting.report import percentile
from device_agent import __main__ as agent
from device_agent import drivers
from device_agent.runtime.control import control_loop
from device_agent.runtime.control.controller import Controller

LIGHT: Final = "light"
DIVIDER: Final = "--"


class LoopStatistics(msgspec.Struct):
    """Lateness of all control loops: interval between two decisions minus the period [ms]."""

    robots: int
    decisions: int
    late_p50_ms: float
    late_p99_ms: float
    late_max_ms: float


class LoopObserver:
    """Records when each loop decides."""

    def __init__(self) -> None:
        self._last: dict[int, float] = {}
        self.late_ms: list[float] = []
        self.periods_s: dict[int, float] = {}

    def install(self) -> None:
        """Wraps the update of every controller."""
        update, init = Controller.update, control_loop.ControlLoop.__init__
        observer = self

        def observed(controller: Controller, *args: Any, **kwargs: Any) -> Any:
            observer.record(id(controller))
            return update(controller, *args, **kwargs)

        def created(loop: Any, kind: Any, driver: Any, controller: Any, **kwargs: Any) -> None:
            observer.periods_s[id(controller)] = kind.period_ms / 1000
            init(loop, kind, driver, controller, **kwargs)

        Controller.update = observed  # type: ignore[method-assign,assignment]
        control_loop.ControlLoop.__init__ = created  # type: ignore[method-assign,assignment]

    def record(self, controller: int) -> None:
        """Records a decision of a controller."""
        now_s = time.monotonic()
        last_s = self._last.get(controller)
        self._last[controller] = now_s
        if last_s is not None:
            self.late_ms.append((now_s - last_s - self.periods_s.get(controller, 0.0)) * 1000)

    def observe(self, seconds: float) -> LoopStatistics:
        """Observes for this time and returns the statistics."""
        self.late_ms = []
        time.sleep(seconds)
        late = list(self.late_ms) or [float("inf")]
        return LoopStatistics(len(self._last), len(late), percentile(late, 0.5), percentile(late, 0.99), max(late))

    def serve(self) -> None:
        """Handles the requests from standard input."""
        for line in sys.stdin:
            print("statistics", msgspec.json.encode(self.observe(float(line))).decode(), flush=True)


def main(rate_hz: float, arguments: Sequence[str]) -> int:
    """Runs the agent and returns its exit code."""
    drivers._BUILT_IN[LIGHT] = "benchmarks.scale.light_driver"  # type: ignore[index] # noqa: SLF001 (only in the benchmark)
    control_loop.IDLE_RATE_HZ = rate_hz
    observer = LoopObserver()
    observer.install()
    threading.Thread(target=observer.serve, daemon=True).start()
    return agent.main(arguments)


if __name__ == "__main__":
    divider = sys.argv.index(DIVIDER)
    sys.exit(main(float(sys.argv[1]), sys.argv[divider + 1 :]))
