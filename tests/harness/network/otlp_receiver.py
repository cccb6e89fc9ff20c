"""A receiver of traces: OTLP over HTTP, decoded with the exporter's own message types."""

import contextlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

from tests.fakes.tracing import TRACE
from tests.harness.network.brokers import wait_until
from tests.harness.network.http_server import QuietHandler, serve


@dataclass(frozen=True, slots=True)
class ReceivedSpan:
    """One exported span. ``parent``: id of its parent, in hexadecimal digits."""

    service: str
    name: str
    id: str
    parent: str
    trace: str
    failed: bool
    message: str
    attributes: dict[str, Any]
    start_ns: int
    end_ns: int


@dataclass(eq=False)
class OtlpReceiver:
    """The received spans.

    Attributes:
        url: Value of ``OTEL_EXPORTER_OTLP_ENDPOINT``.
        answers: While cleared, a request receives no response.
    """

    url: str = ""
    requests: int = 0
    spans: list[ReceivedSpan] = field(default_factory=list)
    answers: threading.Event = field(default_factory=threading.Event)

    def environment(self) -> dict[str, str]:
        """Variables of a program that exports to this receiver without delay."""
        return {"OTEL_EXPORTER_OTLP_ENDPOINT": self.url, "OTEL_BSP_SCHEDULE_DELAY": "50"}

    def named(self, name: str, trace: str = TRACE) -> list[ReceivedSpan]:
        return [span for span in list(self.spans) if span.name == name and span.trace == trace]

    def wait_for(self, name: str, trace: str = TRACE) -> ReceivedSpan:
        wait_until(lambda: self.named(name, trace), f"the span '{name}'")
        return self.named(name, trace)[0]

    def wait_for_id(self, span_id: str) -> ReceivedSpan:
        wait_until(lambda: any(span.id == span_id for span in list(self.spans)), f"the span {span_id}")
        return next(span for span in self.spans if span.id == span_id)

    def receive(self, content: bytes) -> None:
        for resource in ExportTraceServiceRequest.FromString(content).resource_spans:
            service = next(
                each.value.string_value for each in resource.resource.attributes if each.key == "service.name"
            )
            self.spans += [
                ReceivedSpan(
                    service=service,
                    name=span.name,
                    id=span.span_id.hex(),
                    parent=span.parent_span_id.hex(),
                    trace=span.trace_id.hex(),
                    message=span.status.message,
                    failed=span.status.code == span.status.STATUS_CODE_ERROR,
                    attributes={
                        each.key: getattr(each.value, str(each.value.WhichOneof("value"))) for each in span.attributes
                    },
                    start_ns=span.start_time_unix_nano,
                    end_ns=span.end_time_unix_nano,
                )
                for scope in resource.scope_spans
                for span in scope.spans
            ]


def last_exports() -> set[threading.Thread]:
    """Threads of closed tracing adapters of this process that still export their last spans."""
    return {thread for thread in threading.enumerate() if thread.name == "last traces"}


@contextlib.contextmanager
def start_receiver() -> Iterator[OtlpReceiver]:
    """Receive traces until the context ends."""
    receiver = OtlpReceiver()
    receiver.answers.set()

    class Handler(QuietHandler):
        def handle_any(self) -> None:
            receiver.requests += 1
            content = self.rfile.read(int(self.headers["content-length"]))
            receiver.answers.wait()
            assert self.path == "/v1/traces"
            receiver.receive(content)
            self.respond(200, [("content-type", "application/x-protobuf")], b"")

    with _ended_exporters(), serve(Handler) as receiver.url:
        try:
            yield receiver
        finally:
            receiver.answers.set()


@contextlib.contextmanager
def _ended_exporters() -> Iterator[None]:
    """End the exporters of this process that the context creates: retries in the background use ``random``.

    Hypothesis rejects a test of the same process during which that happens.
    """
    created: list[OTLPSpanExporter] = []
    with pytest.MonkeyPatch.context() as patch:
        initialize = OTLPSpanExporter.__init__

        def record(exporter: OTLPSpanExporter, *arguments: Any, **options: Any) -> None:
            initialize(exporter, *arguments, **options)
            created.append(exporter)

        patch.setattr(OTLPSpanExporter, "__init__", record)
        yield
    for exporter in created:
        exporter.shutdown()
    wait_until(lambda: not last_exports(), "the exporters to end")
