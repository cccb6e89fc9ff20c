"""Tracing that records the names of remote spans; every step belongs to one trace."""

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext

TRACE = "0af7651916cd43dd8448eb211c80319c"
CALLER = "b7ad6b7169203331"
TRACEPARENT = f"00-{TRACE}-{CALLER}-01"
"""A trace that a client began, and the client's span."""


class FakeTracing:
    """See ``Tracing``.

    Attributes:
        traceparent: The present span; empty: outside a trace.
        remotes: Name and context of each remote span.
        described: Arguments of ``describe``.
    """

    enabled = True

    def __init__(self, traceparent: str = TRACEPARENT) -> None:
        self.traceparent = traceparent
        self.remotes: list[tuple[str, str]] = []
        self.described: list[tuple[str, dict[str, str | int], bool]] = []

    def span(self, name: str, /) -> AbstractContextManager[object]:
        return nullcontext(name)

    def current(self) -> str:
        return self.traceparent

    @contextmanager
    def remote(self, name: str, traceparent: str, *, message: bool = False) -> Iterator["FakeTracing"]:
        del message
        self.remotes.append((name, traceparent))
        yield self

    def describe(self, name: str, attributes: Mapping[str, str | int], *, failed: bool = False) -> None:
        self.described.append((name, dict(attributes), failed))

    def close(self) -> None:
        """Nothing to export."""
