"""What the space's other devices have measured last, as this agent heard it.

The age of a reading counts from its arrival on the agent's own monotonic clock: a sender's clock decides nothing.
"""

import threading
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from device_agent.protocol import JointTelemetry, Measurements, codec, topics
from device_agent.protocol.topics import Topic
from device_agent.runtime.errors import Refused

OVERTAKEN_S = 2.0
"""A message that is older than the one before is left out, unless silence of this length lay between: then the sender
began anew."""

Values = Mapping[str, float | bool]


@dataclass(frozen=True, slots=True, order=True)
class Source:
    """One stream of one device. ``device`` is its id, ``{agent}-{name}``."""

    device: str
    stream: str

    def __str__(self) -> str:
        """As errors and events name it."""
        return f"{self.device}/{self.stream}"


@dataclass(frozen=True, slots=True)
class Reading:
    """The newest values of a stream, and how long ago they arrived [s]."""

    values: Values
    age_s: float


@dataclass(frozen=True, slots=True)
class _Heard:
    values: Values
    at_s: float
    tick_ms: int
    sequence: int


class ReadingCache:
    """The newest reading of each source. Thread-safe; memory is bounded by the sources, which never change.

    Args:
        space: Id of the space.
        agent: Id of this agent.
        own: Names of its own devices: they may be named without the agent's id.
        named: Device and stream of each source that ``agent.toml`` names.
        clock_s: Monotonic clock [s].
    """

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
        self._heard: dict[Source, _Heard] = {}
        self.sources = frozenset(self.source(device, stream) for device, stream in named)

    def source(self, device: str, stream: str) -> Source:
        """The source that people mean by ``device``: a device of this agent by its name, or any by its id."""
        return Source(f"{self._agent}-{device}" if device in self._own else device, stream)

    def topics(self) -> tuple[str, ...]:
        """What to subscribe to: the sources that are not this agent's own, by exact name."""
        found = []
        for source in sorted(self.sources):
            agent, _, name = source.device.partition("-")
            if agent != self._agent:
                found.append(topics.device(self._space, agent, name, topics.TELE, source.stream))
        return tuple(found)

    def latest(self, device: str, stream: str) -> Reading | None:
        """The newest reading, or ``None`` where nothing was heard since the agent started.

        Args:
            device: Id of a device of this space, or the name of one of this agent's.
            stream: Name of the stream.

        Raises:
            Refused: ``agent.toml`` does not name this stream, so it is not listened to.
        """
        source = self.source(device, stream)
        if source not in self.sources:
            known = ", ".join(map(str, sorted(self.sources))) or "none"
            raise Refused(
                "unknown_stream",
                f"{str(source)[:140]} is not listened to; name it under [[room]] in agent.toml. There is: {known}"[
                    :500
                ],
            )
        return self.read(source)

    def newest(self, stream: str, value: str) -> Reading | None:
        """The newest reading of any device's stream of this name that has this value."""
        found = [self.read(source) for source in self.sources if source.stream == stream]
        having = [reading for reading in found if reading is not None and value in reading.values]
        return min(having, key=lambda reading: reading.age_s, default=None)

    def read(self, source: Source) -> Reading | None:
        """As ``latest``, of a source that is listened to."""
        now_s = self._clock_s()
        with self._lock:
            heard = self._heard.get(source)
        return None if heard is None else Reading(heard.values, max(0.0, now_s - heard.at_s))

    def receive(self, topic: Topic, payload: bytes) -> None:
        """Take in a message of another agent; one that is not listened to, or cannot be read, is let go.

        Raises:
            ProtocolError: It is listened to, and is not a measurement.
        """
        source = Source(f"{topic.agent}-{topic.device}", topic.name)
        if topic.space != self._space or topic.kind != topics.TELE or source not in self.sources:
            return
        if source.stream == topics.JOINTS:
            self._put(source, codec.decode(payload, JointTelemetry))
        else:
            self._put(source, codec.decode(payload, Measurements))

    def note(self, device: str, stream: str, measured: Measurements | JointTelemetry) -> None:
        """Take in what a device of this agent has measured.

        Args:
            device: Its name.
            stream: Name of the stream.
            measured: Just now.
        """
        source = self.source(device, stream)
        if source in self.sources:
            self._put(source, measured)

    def _put(self, source: Source, measured: Measurements | JointTelemetry) -> None:
        values = measured.values if isinstance(measured, Measurements) else _joint_values(measured)
        now_s = self._clock_s()
        with self._lock:
            before = self._heard.get(source)
            if before is not None and now_s - before.at_s < OVERTAKEN_S and _older(measured, before):
                return
            self._heard[source] = _Heard(values, now_s, measured.tick_ms, measured.sequence)


def _joint_values(measured: JointTelemetry) -> Values:
    """By quantity and place in ``Description.joints``: ``position_rad.0``."""
    quantities = {
        "position_rad": measured.position_rad,
        "velocity_rad_s": measured.velocity_rad_s,
        "effort_nm": measured.effort_nm,
    }
    return {f"{name}.{index}": value for name, values in quantities.items() for index, value in enumerate(values)}


def _older(measured: Measurements | JointTelemetry, before: _Heard) -> bool:
    """Whether it was sent before, by both counts: a sender that restarted has a lower sequence, and a later tick."""
    return measured.sequence <= before.sequence and measured.tick_ms <= before.tick_ms
