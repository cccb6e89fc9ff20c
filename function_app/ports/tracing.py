"""Spans of requests and messages, for a tracing system. A trace begins outside the server, with a ``traceparent``."""

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol


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
