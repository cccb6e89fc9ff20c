"""What a device measures besides its joints, stream by stream at its own rate, in a thread that may wait.

The control loop knows nothing of it: a sonar that is slow to answer must not cost a period.
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.ports.driver import ReportsStreams
from device_agent.protocol import Measurements, Stream, topics
from device_agent.runtime.readings import Reading, Values
from device_agent.runtime.telemetry.periodic_poller import PeriodicPoller


class StreamSampler:
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
        driver: ReportsStreams | None,
        *,
        name: str,
        tell: Callable[[str, Measurements], None],
    ) -> None:
        self._tell = tell
        self._told: Counter[str] = Counter()
        self._latest: Mapping[str, tuple[Values, float]] = {}
        asked = [] if driver is None else [stream for stream in streams if stream.name != topics.JOINTS]
        self._driver = driver
        self._rounds = PeriodicPoller(asked, self._ask, device=name, what="stream")

    def start(self) -> None:
        """Begin, where there is something to ask for."""
        self._rounds.start()

    def stop(self) -> None:
        """End. May be called twice."""
        self._rounds.stop()

    def latest(self) -> Mapping[str, Reading]:
        """The newest values of each stream that has been measured."""
        now_s = time.monotonic()
        return {stream: Reading(values, max(0.0, now_s - at_s)) for stream, (values, at_s) in self._latest.items()}

    def _ask(self, stream: str) -> None:
        given: Values = {} if self._driver is None else self._driver.report(stream)
        values = {name: value for name, value in given.items() if math.isfinite(value)}
        if values:
            self._told[stream] += 1
            self._latest = {**self._latest, stream: (values, time.monotonic())}
            self._tell(
                stream, Measurements(tick_ms=tick_ms(), at_ms=wall_ms(), sequence=self._told[stream], values=values)
            )
