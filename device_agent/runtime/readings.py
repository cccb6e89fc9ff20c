"""Cache of the newest measurements of the space's devices.

The age of a reading counts from its arrival on the agent's monotonic clock, so that it does not depend on a sender's
clock.
"""

import threading
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from device_agent.protocol import JointTelemetry, Measurements, codec, topics
from device_agent.protocol.topics import Topic
from device_agent.runtime.errors import Refused

RESTART_GAP_S = 2.0
"""A message that is older than the previous one is dropped, except after a gap of this length: then the sender has
restarted [s]."""

Values = Mapping[str, float | bool]


@dataclass(frozen=True, slots=True, order=True)
class Source:
    """One stream of one device. ``device`` is the id ``{agent}-{name}``."""

    device: str
    stream: str

    def __str__(self) -> str:
        """Name in errors and events."""
        return f"{self.device}/{self.stream}"


@dataclass(frozen=True, slots=True)
class Reading:
    """The newest values of a stream, and the time since their arrival [s]."""

    values: Values
    age_s: float


@dataclass(frozen=True, slots=True)
class _Received:
    values: Values
    at_s: float
    tick_ms: int
    sequence: int


class ReadingCache:
    """The newest reading of each source. Thread-safe; memory is bounded by the fixed set of sources."""

    def __init__(
        self,
        *,
        space: str,
        agent: str,
        own: Collection[str],
        named: Collection[tuple[str, str]] = (),
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._space = space
        self._agent = agent
        self._own = frozenset(own)
        self._clock_s = clock_s
        self._lock = threading.Lock()
        self._received: dict[Source, _Received] = {}
        self._listener: Callable[[str, str, Measurements], None] | None = None
        self.sources = frozenset(self.source(device, stream) for device, stream in named)

    def listen(self, listener: Callable[[str, str, Measurements], None]) -> None:
        """Call ``listener`` with device id, stream and each new measurement of a source. It must not block."""
        self._listener = listener

    def source(self, device: str, stream: str) -> Source:
        """The source for a device of this agent by its name, or any device by its id."""
        return Source(f"{self._agent}-{device}" if device in self._own else device, stream)

    def topics(self) -> tuple[str, ...]:
        """Topics to subscribe to: the sources of other agents."""
        filters = []
        for source in sorted(self.sources):
            agent, _, name = source.device.partition("-")
            if agent != self._agent:
                filters.append(topics.device(self._space, agent, name, topics.TELE, source.stream))
        return tuple(filters)

    def latest(self, device: str, stream: str) -> Reading | None:
        """The newest reading of a device's stream, or ``None`` if none has arrived since the agent started.

        Raises:
            Refused: ``agent.toml`` does not name this stream, so the agent does not subscribe to it.
        """
        source = self.source(device, stream)
        if source not in self.sources:
            sources = ", ".join(map(str, sorted(self.sources))) or "none"
            message = (
                f"{str(source)[:140]} is not subscribed; add it under [[room]] in agent.toml. There are: {sources}"
            )
            raise Refused("unknown_stream", message[:500])
        return self.read(source)

    def newest(self, stream: str, value: str) -> Reading | None:
        """The newest reading among all devices' streams of this name that contain this value."""
        readings = [self.read(source) for source in self.sources if source.stream == stream]
        candidates = [reading for reading in readings if reading is not None and value in reading.values]
        return min(candidates, key=lambda reading: reading.age_s, default=None)

    def read(self, source: Source) -> Reading | None:
        """The newest reading of a subscribed source; see ``latest``."""
        now_s = self._clock_s()
        with self._lock:
            received = self._received.get(source)
        return None if received is None else Reading(received.values, max(0.0, now_s - received.at_s))

    def receive(self, topic: Topic, payload: bytes) -> None:
        """Store a message of another agent if it is from a subscribed source.

        Raises:
            ProtocolError: The message is from a subscribed source, but not a measurement.
        """
        source = Source(f"{topic.agent}-{topic.device}", topic.name)
        if topic.space != self._space or topic.kind != topics.TELE or source not in self.sources:
            return
        if source.stream == topics.JOINTS:
            self._store(source, codec.decode(payload, JointTelemetry))
        else:
            self._store(source, codec.decode(payload, Measurements))

    def record(self, device: str, stream: str, measured: Measurements | JointTelemetry) -> None:
        """Store a measurement of a device of this agent."""
        source = self.source(device, stream)
        if source in self.sources:
            self._store(source, measured)

    def _store(self, source: Source, measured: Measurements | JointTelemetry) -> None:
        values = measured.values if isinstance(measured, Measurements) else _joint_values(measured)
        now_s = self._clock_s()
        with self._lock:
            before = self._received.get(source)
            if before is not None and now_s - before.at_s < RESTART_GAP_S and _is_older(measured, before):
                return
            self._received[source] = _Received(values, now_s, measured.tick_ms, measured.sequence)
        if self._listener is not None and isinstance(measured, Measurements):
            self._listener(source.device, source.stream, measured)


def _joint_values(measured: JointTelemetry) -> Values:
    """Values by quantity and index in ``Description.joints``, for example ``position_rad.0``."""
    quantities = {
        "position_rad": measured.position_rad,
        "velocity_rad_s": measured.velocity_rad_s,
        "effort_nm": measured.effort_nm,
    }
    return {f"{name}.{index}": value for name, values in quantities.items() for index, value in enumerate(values)}


def _is_older(measured: Measurements | JointTelemetry, before: _Received) -> bool:
    """Whether it was sent earlier by sequence and tick: a restarted sender has a lower sequence but a later tick."""
    return measured.sequence <= before.sequence and measured.tick_ms <= before.tick_ms
