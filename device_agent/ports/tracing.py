"""Spans of commands, for a tracing system."""

from typing import Protocol

from msgspec import UNSET, UnsetType

from device_agent.protocol import AckStatus, Command, Reason


class CommandTraces(Protocol):
    """Spans from the arrival of each traced command to its terminal ack. Thread-safe; never blocks and never raises.

    Example::

        traces.begin(command)
        context = traces.step(command.id, AckStatus.DONE)
        traces.end(command.id)
    """

    def begin(self, command: Command) -> None:
        """Begin the span of a new command, if it is traced."""

    def step(self, command: str, status: AckStatus, reason: Reason | None = None) -> str | UnsetType:
        """Record that a command has reached ``status``; returns the ``traceparent`` for this ack."""

    def end(self, command: str) -> None:
        """End the span of a command: its terminal ack was published."""

    def close(self) -> None:
        """Export the last spans, within a second. May be called twice."""


class NoTraces:
    """``CommandTraces`` without a tracing system."""

    def begin(self, command: Command) -> None:
        """See ``CommandTraces``."""

    def step(self, command: str, status: AckStatus, reason: Reason | None = None) -> str | UnsetType:  # noqa: ARG002
        """See ``CommandTraces``."""
        return UNSET

    def end(self, command: str) -> None:
        """See ``CommandTraces``."""

    def close(self) -> None:
        """See ``CommandTraces``."""
