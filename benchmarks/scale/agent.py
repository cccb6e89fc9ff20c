"""The agent with the additional driver ``light`` and an observer of its control loops.

``python -m benchmarks.scale.agent RATE_HZ -- …`` passes the remaining arguments to ``device_agent``. For each line
with a number of seconds on standard input it observes for that time and prints ``seen`` and ``LoopStatistics`` as JSON.
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
    """Of all control loops together: how much later than a period each decision came after the one before [ms]."""

    robots: int
    decisions: int
    late_p50_ms: float
    late_p99_ms: float
    late_most_ms: float


class LoopObserver:
    """Notes when each loop decides."""

    def __init__(self) -> None:
        self._last: dict[int, float] = {}
        self.late_ms: list[float] = []
        self.periods_s: dict[int, float] = {}

    def install(self) -> None:
        """In place of what a controller does; it still does it."""
        step, begin = Controller.update, control_loop.ControlLoop.__init__
        watcher = self

        def watched(controller: Controller, *given: Any, **named: Any) -> Any:
            watcher.note(id(controller))
            return step(controller, *given, **named)

        def made(made_loop: Any, kind: Any, driver: Any, controller: Any, **more: Any) -> None:
            watcher.periods_s[id(controller)] = kind.period_ms / 1000
            begin(made_loop, kind, driver, controller, **more)

        Controller.update = watched  # type: ignore[method-assign,assignment]
        control_loop.ControlLoop.__init__ = made  # type: ignore[method-assign,assignment]

    def note(self, controller: int) -> None:
        """It decides now."""
        now_s = time.monotonic()
        last_s = self._last.get(controller)
        self._last[controller] = now_s
        if last_s is not None:
            self.late_ms.append((now_s - last_s - self.periods_s.get(controller, 0.0)) * 1000)

    def watch(self, seconds: float) -> LoopStatistics:
        """From now on."""
        self.late_ms = []
        time.sleep(seconds)
        late = list(self.late_ms) or [float("inf")]
        return LoopStatistics(len(self._last), len(late), percentile(late, 0.5), percentile(late, 0.99), max(late))

    def answer(self) -> None:
        """What is asked on standard input."""
        for line in sys.stdin:
            print("seen", msgspec.json.encode(self.watch(float(line))).decode(), flush=True)


def main(rate_hz: float, arguments: Sequence[str]) -> int:
    """The agent's exit code."""
    drivers._BUILT_IN[LIGHT] = "benchmarks.scale.light_driver"  # type: ignore[index] # noqa: SLF001 (of the bench alone)
    control_loop.IDLE_RATE_HZ = rate_hz
    watcher = LoopObserver()
    watcher.install()
    threading.Thread(target=watcher.answer, daemon=True).start()
    return agent.main(arguments)


if __name__ == "__main__":
    divider = sys.argv.index(DIVIDER)
    sys.exit(main(float(sys.argv[1]), sys.argv[divider + 1 :]))
