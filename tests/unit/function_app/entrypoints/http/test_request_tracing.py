"""Which requests are traced, and the trace id in the log."""

import json
import logging

import pytest

from device_agent.protocol.security.log_output import JsonFormatter
from function_app.entrypoints.http import create_app
from tests.fakes.tracing import TRACE, TRACEPARENT, FakeTracing
from tests.harness.cloud.cloud import API, Cloud

HEALTH = f"{API}/health/live"
OTHER = f"00-{TRACE}-{'1' * 16}-01"


@pytest.fixture
def tracing(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> FakeTracing:
    tracing = FakeTracing()
    monkeypatch.setattr(cloud.functions, "tracing", tracing)
    monkeypatch.setattr(cloud, "app", create_app(cloud.functions))
    return tracing


def test_a_request_with_a_context_is_a_span_of_its_route(cloud: Cloud, tracing: FakeTracing) -> None:
    assert cloud.request("GET", HEALTH, headers={"traceparent": TRACEPARENT}).status_code == 200
    assert tracing.remotes == [("GET", TRACEPARENT)]
    attributes = {"http.request.method": "GET", "http.response.status_code": 200, "http.route": HEALTH}
    assert tracing.described == [(f"GET {HEALTH}", attributes, False)]


def test_an_unknown_path_is_not_part_of_a_name(cloud: Cloud, tracing: FakeTracing) -> None:
    cloud.request("PUT", f"{API}/secret", headers={"traceparent": TRACEPARENT})
    ((name, attributes, _),) = tracing.described
    assert name == "PUT"
    assert "secret" not in str(attributes)


@pytest.mark.parametrize(
    "headers",
    [
        [],
        [("traceparent", "")],
        [("traceparent", f"{TRACEPARENT}x")],
        [("traceparent", TRACEPARENT.upper())],
        [("traceparent", f"00-{'0' * 32}-{'1' * 16}-01")],
        [("traceparent", TRACEPARENT), ("traceparent", OTHER)],
        [("tracestate", "a=b")],
    ],
)
def test_a_request_without_a_valid_context_is_not_traced(
    cloud: Cloud, tracing: FakeTracing, headers: list[tuple[str, str]]
) -> None:
    assert cloud.request("GET", HEALTH, headers=headers).status_code == 200
    assert tracing.remotes == []


def test_a_failure_is_marked_and_its_log_line_names_the_trace(
    cloud: Cloud, tracing: FakeTracing, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines: list[dict[str, str]] = []

    class Output(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            lines.append(json.loads(JsonFormatter().format(record)))

    async def fail() -> None:
        raise RuntimeError

    monkeypatch.setattr(cloud.functions.health, "check", fail)
    output = Output()
    logging.getLogger("function_app").addHandler(output)
    try:
        for headers in ({"traceparent": TRACEPARENT}, {}):
            assert cloud.request("GET", f"{API}/health", headers=headers).status_code == 500
    finally:
        logging.getLogger("function_app").removeHandler(output)
    assert [line.get("trace_id") for line in lines] == [TRACE, None]
    assert [failed for _, _, failed in tracing.described] == [True]
