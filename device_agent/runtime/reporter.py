"""What a device measures besides its joints, stream by stream at its own rate, in a thread that may wait.

The control loop knows nothing of it: a sonar that is slow to answer must not cost a period.
"""

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.ports.driver import DriverError, Reporting
from device_agent.protocol import topics
from device_agent.protocol.messages import Measurements, Stream
from device_agent.runtime.room import Reading, Values

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Due:
    """One stream: its period [s], when it is next asked for [s], how many were told, and what is wrong with it."""

    period_s: float
    due_s: float
    sequence: int = 0
    trouble: str = ""


class Reporter:
    """Asks a driver for its streams, and tells them.

    Args:
        streams: Those of the robot type.
        driver: What measures them; ``None``: it measures nothing but joints.
        name: The device's name.
        tell: Called with each stream's measurements; must not block for long.
    """

    def __init__(
        self,
        streams: Sequence[Stream],
        driver: Reporting | None,
        *,
        name: str,
        tell: Callable[[str, Measurements], None],
    ) -> None:
        self._driver = driver
        self._name = name
        self._tell = tell
        self._streams = {
            stream.name: _Due(1 / stream.rate_hz, -math.inf) for stream in streams if stream.name != topics.JOINTS
        }
        self._latest: Mapping[str, tuple[Values, float]] = {}
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{name}-reporter", daemon=True)

    def start(self) -> None:
        """Begin, where there is something to ask for."""
        if self._driver is not None and self._streams:
            self._thread.start()

    def stop(self) -> None:
        """End. May be called twice."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2)

    def latest(self) -> Mapping[str, Reading]:
        """The newest values of each stream that has been measured."""
        now_s = time.monotonic()
        return {stream: Reading(values, max(0.0, now_s - at_s)) for stream, (values, at_s) in self._latest.items()}

    def _run(self) -> None:
        wait_s = 0.0
        while self._driver is not None and not self._stopping.wait(wait_s):
            now_s = time.monotonic()
            for stream, due in self._streams.items():
                if due.due_s <= now_s:
                    following_s = due.due_s + due.period_s
                    # Late ones are left out, not made up for.
                    due.due_s = following_s if following_s > now_s else now_s + due.period_s
                    self._ask(self._driver, stream, due)
            wait_s = max(0.0, min(due.due_s for due in self._streams.values()) - time.monotonic())

    def _ask(self, driver: Reporting, stream: str, due: _Due) -> None:
        try:
            values = {name: value for name, value in driver.report(stream).items() if math.isfinite(value)}
            if values:
                due.sequence += 1
                self._latest = {**self._latest, stream: (values, time.monotonic())}
                measured = Measurements(tick_ms=tick_ms(), at_ms=wall_ms(), sequence=due.sequence, values=values)
                self._tell(stream, measured)
        except DriverError as error:
            self._note(stream, due, str(error))
        except Exception as error:  # noqa: BLE001 (one bad measurement must not end all of them)
            self._note(stream, due, f"internal error: {error!r}")
        else:
            self._note(stream, due, "")

    def _note(self, stream: str, due: _Due, trouble: str) -> None:
        """Log trouble when it comes and when it goes, not at every measurement."""
        if trouble != due.trouble:
            due.trouble = trouble
            _log.warning("%s: stream %s: %s", self._name, stream, trouble or "is measured again")
