"""Traces that are exported with OTLP over HTTP. The only module of the agent that imports OpenTelemetry."""

import os
import socket
import threading
from dataclasses import dataclass

from msgspec import UNSET, UnsetType
from opentelemetry import trace
from opentelemetry.context import Context
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import OTELResourceDetector, Resource
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor
from opentelemetry.trace import Span, SpanKind, Status, StatusCode
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

from device_agent.protocol import AckStatus, Command, Reason, RunMovement, RunTrial, Task
from device_agent.protocol.fields import trace_id
from device_agent.transports.pairing_monitor import SOFTWARE

_FLUSH_S = 1.0
_MAX_OPEN = 1000
"""Spans of commands that may be open; the oldest is abandoned."""
_PROPAGATOR = TraceContextTextMapPropagator()


@dataclass(eq=False, slots=True)
class _CommandSpans:
    """The span of a command, and the one of its present step."""

    whole: Span
    step: Span


class OtlpTraces:
    """``CommandTraces`` with a bounded queue, which a thread exports. While the receiver fails, spans are dropped.

    An action has the steps *accept*, *execute* and *publish ack*; other commands have *apply* instead of the first two.
    """

    def __init__(self) -> None:
        name, _, version = SOFTWARE.partition(" ")
        service = {
            "service.name": name,
            "service.version": version,
            "service.instance.id": f"{socket.gethostname()}:{os.getpid()}",
        }
        resource = Resource(service).merge(OTELResourceDetector().detect())
        self._provider = TracerProvider(resource=resource, shutdown_on_exit=False)
        self._provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
        self._tracer = self._provider.get_tracer("telescope", version)
        self._lock = threading.Lock()
        self._open: dict[str, _CommandSpans] = {}

    def begin(self, command: Command) -> None:
        """See ``CommandTraces``."""
        if not trace_id(command.traceparent):
            return
        kind = str(type(command.request).__struct_config__.tag)
        parent = _PROPAGATOR.extract({"traceparent": str(command.traceparent)}, Context())
        whole = self._tracer.start_span(
            f"command {kind}",
            parent,
            SpanKind.CONSUMER,
            {"telescope.command": command.id, "telescope.device": command.device},
        )
        first = "accept" if isinstance(command.request, RunMovement | RunTrial | Task) else "apply"
        spans = _CommandSpans(whole, self._child(whole, first))
        with self._lock:
            self._open[command.id] = spans
            if len(self._open) > _MAX_OPEN:
                del self._open[next(iter(self._open))]

    def step(self, command: str, status: AckStatus, reason: Reason | None = None) -> str | UnsetType:
        """See ``CommandTraces``."""
        with self._lock:
            spans = self._open.get(command)
        if spans is None:
            return UNSET
        if status is AckStatus.ACCEPTED:
            self._next(spans, "execute")
        elif status.terminal:
            if status is not AckStatus.DONE:
                spans.whole.set_status(Status(StatusCode.ERROR, reason.code if reason else status.value))
            self._next(spans, "publish ack", SpanKind.PRODUCER)
        carrier: dict[str, str] = {}
        _PROPAGATOR.inject(carrier, trace.set_span_in_context(spans.step, Context()))
        return carrier["traceparent"]

    def end(self, command: str) -> None:
        """See ``CommandTraces``."""
        with self._lock:
            spans = self._open.pop(command, None)
        if spans is not None:
            spans.step.end()
            spans.whole.end()

    def close(self) -> None:
        """See ``CommandTraces``."""
        # In a thread: the exporter retries for longer than an orderly end may take.
        ending = threading.Thread(target=self._provider.shutdown, name="last traces", daemon=True)
        ending.start()
        ending.join(_FLUSH_S)

    def _next(self, spans: _CommandSpans, name: str, kind: SpanKind = SpanKind.INTERNAL) -> None:
        spans.step.end()
        spans.step = self._child(spans.whole, name, kind)

    def _child(self, whole: Span, name: str, kind: SpanKind = SpanKind.INTERNAL) -> Span:
        return self._tracer.start_span(name, trace.set_span_in_context(whole, Context()), kind)
