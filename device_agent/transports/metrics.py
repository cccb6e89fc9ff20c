"""Metrics of one agent for Prometheus. They are collected where messages pass and read when they are requested."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Self

import prometheus_client as prometheus
from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from device_agent.ports.transport import LinkChanged, Receive, Transport
from device_agent.protocol import Event, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.events import EventKind
from device_agent.runtime.device import Device
from device_agent.runtime.load import LoadGovernor
from device_agent.runtime.telemetry.outbox import Outbox

_LATENESS_S = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.5)
_RECENT = 100
"""Events may be sent again; an event whose id is among so many recent ones is counted once."""


class AgentMetrics(Collector):
    """Metrics of the agent, over all of its devices."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        prometheus.ProcessCollector(registry=self.registry)
        self._lateness = prometheus.Histogram(
            "telescope_agent_period_lateness_seconds",
            "Delay of the start of a control period",
            buckets=_LATENESS_S,
            registry=self.registry,
        )
        self._period = prometheus.Gauge(
            "telescope_agent_period_seconds", "Length of a control period", registry=self.registry
        )
        self._setpoints = prometheus.Counter(
            "telescope_agent_setpoints_received", "Received setpoints", registry=self.registry
        )
        self._held = prometheus.Counter(
            "telescope_agent_motion_held",
            "Motion that was brought to a hold; watchdog: setpoints stopped arriving",
            ("reason",),
            registry=self.registry,
        )
        self._connects = prometheus.Counter(
            "telescope_agent_connections", "Connections to the cloud", registry=self.registry
        )
        self._connected = prometheus.Gauge(
            "telescope_agent_connected", "Whether the agent is connected", registry=self.registry
        )
        self.load: LoadGovernor = _MeasuredLoad(self._lateness.observe, self._period.set)
        self._devices: Mapping[str, Device] = {}
        self._outbox: Outbox | None = None
        self._recent: deque[str] = deque(maxlen=_RECENT)
        self.registry.register(self)

    @classmethod
    def serve(cls, port: int) -> Self:
        """Metrics that are served on the loopback address, in a thread.

        Raises:
            OSError: The port cannot be used.
        """
        metrics = cls()
        prometheus.start_http_server(port, addr="127.0.0.1", registry=metrics.registry)
        return metrics

    def read_from(self, devices: Mapping[str, Device], outbox: Outbox) -> None:
        """Set the objects that are read when metrics are requested."""
        self._devices, self._outbox = devices, outbox

    def measured(self, transport: Transport) -> Transport:
        """The transport, with its messages and connections counted."""
        return _MeasuredTransport(transport, self)

    def collect(self) -> Iterator[Metric]:
        """See ``Collector``."""
        rejected: dict[str, int] = {}
        for device in self._devices.values():
            for code, count in device.publisher.rejections.copy().items():
                rejected[code] = rejected.get(code, 0) + count
        family = CounterMetricFamily("telescope_agent_rejections", "Rejected messages, by reason", labels=("reason",))
        for code, count in rejected.items():
            family.add_metric((code,), count)
        yield family
        size = 0 if self._outbox is None else self._outbox.stored_bytes
        yield GaugeMetricFamily("telescope_agent_outbox_bytes", "Stored messages that wait for a connection", size)
        yield GaugeMetricFamily("telescope_agent_load_level", "Reduced work: 0 none, 3 all", self.load.level)

    def link_changed(self, up: bool) -> None:
        """Count a connection."""
        self._connected.set(up)
        if up:
            self._connects.inc()

    def received(self, topic: str) -> None:
        """Count a received setpoint."""
        if f"/{topics.CTL}/" in topic:
            self._setpoints.inc()

    def sent(self, topic: str, payload: bytes) -> None:
        """Count a hold that an event reports."""
        if not topic.endswith(f"/{topics.EVENT}") or EventKind.MOTION_HELD.encode() not in payload:
            return
        try:
            event = codec.decode(payload, Event)
        except ProtocolError:
            return
        if event.kind == EventKind.MOTION_HELD and event.id not in self._recent:
            self._recent.append(event.id)
            self._held.labels(str(event.data.get("code", ""))).inc()


class _MeasuredLoad(LoadGovernor):
    def __init__(self, lateness: Callable[[float], None], period: Callable[[float], None]) -> None:
        super().__init__()
        self._lateness = lateness
        self._period = period

    def record_period(self, now_s: float, *, late_s: float, period_s: float) -> None:
        self._lateness(max(0.0, late_s))
        self._period(period_s)
        super().record_period(now_s, late_s=late_s, period_s=period_s)


class _MeasuredTransport:
    """See ``Transport``."""

    def __init__(self, transport: Transport, metrics: AgentMetrics) -> None:
        self._transport = transport
        self._metrics = metrics

    def start(self, receive: Receive, link_changed: LinkChanged) -> None:
        def received(topic: str, payload: bytes) -> None:
            self._metrics.received(topic)
            receive(topic, payload)

        def changed(up: bool) -> None:
            self._metrics.link_changed(up)
            link_changed(up)

        self._transport.start(received, changed)

    def publish(
        self, topic: str, payload: bytes, *, qos: int, retain: bool = False, delivered: Callable[[], None] | None = None
    ) -> bool:
        self._metrics.sent(topic, payload)
        return self._transport.publish(topic, payload, qos=qos, retain=retain, delivered=delivered)

    def stop(self) -> None:
        self._transport.stop()
