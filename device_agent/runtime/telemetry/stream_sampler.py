"""Samples a device's streams other than joints, each at its rate, in a thread that may wait.

It is separate from the control loop, so that a slow sensor cannot delay a control period.
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.ports.driver import ReportsStreams
from device_agent.protocol import Measurements, Stream, topics
from device_agent.runtime.load import LoadGovernor
from device_agent.runtime.readings import Reading, Values
from device_agent.runtime.telemetry.periodic_poller import PeriodicPoller


class StreamSampler(PeriodicPoller):
    """Polls the streams of a driver, and publishes them."""

    def __init__(
        self,
        streams: Sequence[Stream],
        driver: ReportsStreams | None,
        *,
        name: str,
        publish: Callable[[str, Measurements], None],
        load: LoadGovernor,
    ) -> None:
        polled = [] if driver is None else [stream for stream in streams if stream.name != topics.JOINTS]
        super().__init__(polled, self._sample, device=name, kind="stream", share=lambda: load.share("telemetry"))
        self._publish = publish
        self._sequences: Counter[str] = Counter()
        self._latest: Mapping[str, tuple[Values, float]] = {}
        self._driver = driver

    def latest(self) -> Mapping[str, Reading]:
        """The newest values of each measured stream."""
        now_s = time.monotonic()
        return {stream: Reading(values, max(0.0, now_s - at_s)) for stream, (values, at_s) in self._latest.items()}

    def _sample(self, stream: str) -> None:
        measured: Values = {} if self._driver is None else self._driver.report(stream)
        values = {name: value for name, value in measured.items() if math.isfinite(value)}
        if values:
            self._sequences[stream] += 1
            self._latest = {**self._latest, stream: (values, time.monotonic())}
            sequence = self._sequences[stream]
            self._publish(stream, Measurements(tick_ms=tick_ms(), at_ms=wall_ms(), sequence=sequence, values=values))
