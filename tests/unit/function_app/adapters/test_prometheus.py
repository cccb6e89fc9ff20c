import urllib.request

import pytest

from function_app.adapters.local.monitoring.prometheus import PrometheusMetrics
from function_app.ports.monitoring import Counter, Histogram, NoMetrics
from tests.harness.network.ports import free_port


def lines(text: bytes) -> set[str]:
    return {line for line in text.decode().splitlines() if not line.startswith("#")}


def test_counters_durations_and_gauges_are_exposed() -> None:
    metrics = PrometheusMetrics()
    metrics.count(Counter.STOPS, "confirmed")
    metrics.count(Counter.MESSAGES, "tele", by=3)
    metrics.observe(Histogram.HTTP, 0.02, "GET", "/devices", "200")
    found = lines(
        metrics.expose(
            [("telescope_age", "Age", "part", [("a", 1.5), ("b", 2)]), ("telescope_free", "F", "", [("", 7)])]
        )
    )
    assert {
        'telescope_stops_total{outcome="confirmed"} 1.0',
        'telescope_ingest_messages_total{topic_class="tele"} 3.0',
        'telescope_http_request_duration_seconds_bucket{le="0.025",method="GET",route="/devices",status="200"} 1.0',
        'telescope_age{part="a"} 1.5',
        "telescope_free 7.0",
    } <= found


def test_a_gauge_keeps_no_value_that_is_gone() -> None:
    metrics = PrometheusMetrics()
    metrics.expose([("telescope_age", "Age", "part", [("a", 1)])])
    found = lines(metrics.expose([("telescope_age", "Age", "part", [("b", 1)])]))
    assert 'telescope_age{part="b"} 1.0' in found
    assert 'telescope_age{part="a"} 1.0' not in found


def test_a_worker_serves_its_metrics() -> None:
    metrics, port = PrometheusMetrics(), free_port()
    metrics.count(Counter.ACKS, "done")
    server = metrics.serve(port)
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as response:
            assert 'telescope_acks_total{status="done"} 1.0' in lines(response.read())
    finally:
        server()


def test_without_the_package_nothing_is_measured() -> None:
    metrics = NoMetrics()
    metrics.count(Counter.STOPS, "confirmed")
    metrics.observe(Histogram.ACTIONS, 1.0, "done")
    assert metrics.expose([]) == b""
    with pytest.raises(OSError, match="prometheus-client"):
        metrics.serve(1)
