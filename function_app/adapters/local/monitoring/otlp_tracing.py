"""Traces that are exported with OTLP over HTTP. The only module of the server that imports OpenTelemetry."""

import os
import socket
import threading
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext

from opentelemetry import trace
from opentelemetry.context import Context
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import OTELResourceDetector, Resource
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor
from opentelemetry.trace import Span, SpanKind, Status, StatusCode
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

from function_app import VERSION
from function_app.ports.monitoring import RemoteSpan

_FLUSH_S = 1.0
_PROPAGATOR = TraceContextTextMapPropagator()


class OtlpTracing:
    """``Tracing`` with a bounded queue, which a thread exports. While the receiver fails, spans are dropped."""

    enabled = True

    def __init__(self) -> None:
        service = {
            "service.name": "telescope-server",
            "service.version": VERSION,
            "service.instance.id": f"{socket.gethostname()}:{os.getpid()}",
        }
        resource = Resource(service).merge(OTELResourceDetector().detect())
        self._provider = TracerProvider(resource=resource, shutdown_on_exit=False)
        self._provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
        self._tracer = self._provider.get_tracer("telescope", VERSION)

    def span(self, name: str, /) -> AbstractContextManager[object]:
        if not trace.get_current_span().get_span_context().is_valid:
            return nullcontext()
        return self._started(name)

    def current(self) -> str:
        carrier: dict[str, str] = {}
        _PROPAGATOR.inject(carrier)
        return carrier.get("traceparent", "")

    @contextmanager
    def remote(self, name: str, traceparent: str, *, message: bool = False) -> Iterator[RemoteSpan]:
        parent = _PROPAGATOR.extract({"traceparent": traceparent}, Context())
        kind = SpanKind.CONSUMER if message else SpanKind.SERVER
        with self._started(name, parent, kind) as span:
            yield _OtlpSpan(span)

    def close(self) -> None:
        # In a thread: the exporter retries for longer than an orderly end may take.
        ending = threading.Thread(target=self._provider.shutdown, name="last traces", daemon=True)
        ending.start()
        ending.join(_FLUSH_S)

    @contextmanager
    def _started(self, name: str, parent: Context | None = None, kind: SpanKind = SpanKind.INTERNAL) -> Iterator[Span]:
        """A span that becomes the present one. Of an error it has only the type: texts may name persons."""
        with self._tracer.start_as_current_span(
            name, parent, kind, record_exception=False, set_status_on_exception=False
        ) as span:
            try:
                yield span
            except Exception as error:
                span.set_status(Status(StatusCode.ERROR, type(error).__name__))
                raise


class _OtlpSpan:
    def __init__(self, span: Span) -> None:
        self._span = span

    def describe(self, name: str, attributes: Mapping[str, str | int], *, failed: bool = False) -> None:
        self._span.update_name(name)
        self._span.set_attributes(attributes)
        if failed:
            self._span.set_status(Status(StatusCode.ERROR))
