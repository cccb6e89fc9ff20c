"""Traces of the server: their spans, and a receiver that does not answer."""

import logging
import subprocess
import sys
import tempfile
from collections.abc import Iterator

import pytest

from function_app.adapters import factory
from function_app.adapters.local.monitoring.otlp_tracing import OtlpTracing
from function_app.ports.monitoring import NoTracing
from tests.fakes.tracing import CALLER, TRACE, TRACEPARENT
from tests.harness.cloud.cloud import settings
from tests.harness.hosts.host import environment_of
from tests.harness.network.brokers import wait_until
from tests.harness.network.otlp_receiver import OtlpReceiver, last_exports, start_receiver
from tests.harness.paths import ROOT

QUEUE = 2048


@pytest.fixture
def receiver(monkeypatch: pytest.MonkeyPatch) -> Iterator[OtlpReceiver]:
    with start_receiver() as receiver:
        for name, value in receiver.environment().items():
            monkeypatch.setenv(name, value)
        yield receiver


@pytest.fixture
def tracing(receiver: OtlpReceiver) -> Iterator[OtlpTracing]:
    del receiver  # its address is in the environment
    tracing = OtlpTracing()
    yield tracing
    tracing.close()


def test_a_request_and_its_steps_form_one_trace(receiver: OtlpReceiver, tracing: OtlpTracing) -> None:
    with tracing.remote("POST", TRACEPARENT) as request:
        with tracing.span("write action"):
            context = tracing.current()
        request.describe("POST /lease", {"http.response.status_code": 503}, failed=True)
    request_span = receiver.wait_for("POST /lease")
    step = receiver.wait_for("write action")
    assert (request_span.parent, step.parent) == (CALLER, request_span.id)
    assert context == f"00-{TRACE}-{step.id}-01"
    assert request_span.failed
    assert not step.failed
    assert request_span.attributes == {"http.response.status_code": 503}
    assert request_span.service == "telescope-server"


def test_a_failed_step_is_marked_without_its_text(receiver: OtlpReceiver, tracing: OtlpTracing) -> None:
    with pytest.raises(ValueError, match="anna"), tracing.remote("POST", TRACEPARENT), tracing.span("write action"):
        raise ValueError("anna has control")
    for name in ("write action", "POST"):
        span = receiver.wait_for(name)
        assert (span.failed, span.message) == (True, "ValueError")


def test_outside_a_trace_nothing_is_recorded(receiver: OtlpReceiver, tracing: OtlpTracing) -> None:
    with tracing.span("write action"):
        assert tracing.current() == ""
    with tracing.remote("store ack", TRACEPARENT, message=True):
        pass
    receiver.wait_for("store ack")
    assert [span.name for span in receiver.spans] == ["store ack"]


def test_a_trace_that_is_not_sampled_is_not_exported(receiver: OtlpReceiver, tracing: OtlpTracing) -> None:
    with tracing.remote("GET", f"{TRACEPARENT[:-1]}0"):
        assert tracing.current().endswith("-00")
    with tracing.remote("POST", TRACEPARENT):
        pass
    receiver.wait_for("POST")
    assert [span.name for span in receiver.spans] == ["POST"]


@pytest.mark.parametrize("reachable", [True, False])
def test_a_receiver_that_does_not_answer_delays_nothing(
    receiver: OtlpReceiver, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, *, reachable: bool
) -> None:
    caplog.set_level(logging.CRITICAL)
    receiver.answers.clear()
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_TIMEOUT", "1000")
    if not reachable:
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:1")
    tracing = OtlpTracing()
    for _ in range(2 * QUEUE):  # more than the queue holds
        with tracing.remote("POST", TRACEPARENT):
            pass
    if reachable:
        wait_until(lambda: receiver.requests, "an export")
    earlier = last_exports()
    tracing.close()
    assert last_exports() - earlier, "the end did not wait for the exporter, which waits or retries"
    assert not receiver.spans


def test_without_a_receiver_the_sdk_is_not_imported() -> None:
    program = (
        "import sys; from function_app import bootstrap, settings; "
        "from function_app.entrypoints.http import create_app; "
        "create_app(bootstrap.build(settings.read({'TELESCOPE_HOME': sys.argv[1]}))); "
        "from device_agent.cli import run; run._export_traces({}); "
        "sys.exit('opentelemetry.sdk' in sys.modules)"
    )
    with tempfile.TemporaryDirectory() as home:
        subprocess.run([sys.executable, "-c", program, home], cwd=ROOT, env=environment_of({}), check=True)


def test_without_the_packages_the_log_names_the_remedy(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "function_app.adapters.local.monitoring.otlp_tracing", None)
    assert isinstance(factory.tracing(settings(ROOT, tracing=True)), NoTracing)
    assert "telescope-server[tracing]" in caplog.text
