"""Metrics and traces for a monitoring system.

Metrics are counts and durations, with names in the conventions of Prometheus. A trace begins outside the server, with a
``traceparent``.
"""

from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from enum import Enum
from typing import Protocol


class Counter(Enum):
    """Counters: name without the suffix ``_total``, description, label names."""

    COMMANDS = ("telescope_commands", "Commands that were signed for devices", ("kind",))
    ACKS = ("telescope_acks", "Acknowledgements of devices", ("status",))
    MESSAGES = ("telescope_ingest_messages", "Messages that the ingest stored", ("topic_class",))
    CONTROL_EVENTS = ("telescope_control_events", "Events of leases and control requests", ("event",))
    STOPS = ("telescope_stops", "Stops by outcome", ("outcome",))


class Histogram(Enum):
    """Durations [s]: name, description, label names, upper bounds of the buckets."""

    HTTP = (
        "telescope_http_request_duration_seconds",
        "Time from a request to its response",
        ("method", "route", "status"),
        (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0, 30.0),
    )
    ACTIONS = (
        "telescope_action_duration_seconds",
        "Time from the request of an action to its end",
        ("status",),
        (0.1, 0.5, 1.0, 5.0, 15.0, 60.0, 300.0, 1800.0),
    )


Gauge = tuple[str, str, str, Iterable[tuple[str, float]]]
"""Name, description, label name (empty: no label), and values by label value."""


class Metrics(Protocol):
    """Records measurements in memory; never blocks and never raises.

    Values of a label come from a fixed list, such as routes and statuses, never from accounts or devices.

    Example::

        metrics.count(Counter.STOPS, "confirmed")
    """

    def count(self, counter: Counter, *labels: str, by: int = 1) -> None:
        """Increase a counter."""

    def observe(self, histogram: Histogram, seconds: float, *labels: str) -> None:
        """Add a duration [s]."""

    def expose(self, gauges: Iterable[Gauge]) -> bytes:
        """All metrics as text, with the present values of these gauges. Empty: they cannot be read."""

    def serve(self, port: int) -> Callable[[], None]:
        """Serve the metrics of this process on the loopback address, in a thread; returns how to stop that.

        Raises:
            OSError: The port cannot be used.
        """


class NoMetrics:
    """``Metrics`` where no monitoring system can read them."""

    def count(self, counter: Counter, *labels: str, by: int = 1) -> None:
        """See ``Metrics``."""

    def observe(self, histogram: Histogram, seconds: float, *labels: str) -> None:
        """See ``Metrics``."""

    def expose(self, gauges: Iterable[Gauge]) -> bytes:  # noqa: ARG002
        """See ``Metrics``."""
        return b""

    def serve(self, port: int) -> Callable[[], None]:
        """See ``Metrics``."""
        raise OSError(f"port {port} is not served: install the Python package prometheus-client")


class RemoteSpan(Protocol):
    """The span of a request or message from another program."""

    def describe(self, name: str, attributes: Mapping[str, str | int], *, failed: bool = False) -> None:
        """Set name, attributes and outcome, once they are known."""


class Tracing(Protocol):
    """Records spans in memory and exports them later; never blocks and never raises.

    Example::

        with tracing.span("write action"):
            ...

    Attributes:
        enabled: Whether spans are recorded.
    """

    enabled: bool

    def span(self, name: str, /) -> AbstractContextManager[object]:
        """A step of the present trace. Records nothing outside a trace."""

    def current(self) -> str:
        """The present span as ``traceparent`` for messages; empty outside a trace."""

    def remote(self, name: str, traceparent: str, *, message: bool = False) -> AbstractContextManager[RemoteSpan]:
        """The processing of a request, or of a ``message``, with this ``traceparent``."""

    def close(self) -> None:
        """Export the last spans, within a second, and end. May be called twice."""


class _NoSpan:
    def describe(self, name: str, attributes: Mapping[str, str | int], *, failed: bool = False) -> None:
        """See ``RemoteSpan``."""


class NoTracing:
    """``Tracing`` without a tracing system. Its methods are those of the interpreter, so a request pays for none."""

    enabled = False
    span = nullcontext
    current = str

    def remote(self, name: str, traceparent: str, *, message: bool = False) -> AbstractContextManager[RemoteSpan]:  # noqa: ARG002
        """See ``Tracing``."""
        return nullcontext(_NoSpan())

    def close(self) -> None:
        """See ``Tracing``."""
