"""Metrics in the text format of Prometheus."""

from collections.abc import Callable, Iterable

import prometheus_client as prometheus
from prometheus_client import CollectorRegistry

from function_app.ports.monitoring import Counter, Gauge, Histogram


class PrometheusMetrics:
    """``Metrics`` of one process, in a registry of its own."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        prometheus.ProcessCollector(registry=self._registry)
        prometheus.GCCollector(registry=self._registry)
        self._counters = {each: prometheus.Counter(*each.value, registry=self._registry) for each in Counter}
        self._histograms = {}
        for each in Histogram:
            name, description, labels, buckets = each.value
            self._histograms[each] = prometheus.Histogram(
                name, description, labels, buckets=buckets, registry=self._registry
            )
        self._gauges: dict[str, prometheus.Gauge] = {}

    def count(self, counter: Counter, *labels: str, by: int = 1) -> None:
        metric = self._counters[counter]
        (metric.labels(*labels) if labels else metric).inc(by)

    def observe(self, histogram: Histogram, seconds: float, *labels: str) -> None:
        self._histograms[histogram].labels(*labels).observe(seconds)

    def expose(self, gauges: Iterable[Gauge]) -> bytes:
        for name, description, label, values in gauges:
            gauge = self._gauges.get(name)
            if gauge is None:
                labels = (label,) if label else ()
                gauge = self._gauges[name] = prometheus.Gauge(name, description, labels, registry=self._registry)
            gauge.clear()
            for value_label, value in values:
                (gauge.labels(value_label) if label else gauge).set(value)
        return prometheus.generate_latest(self._registry)

    def serve(self, port: int) -> Callable[[], None]:
        server, _ = prometheus.start_http_server(port, addr="127.0.0.1", registry=self._registry)

        def stop() -> None:
            server.shutdown()
            server.server_close()

        return stop
