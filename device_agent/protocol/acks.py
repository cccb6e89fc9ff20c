"""Acknowledgements of commands. Readers ignore unknown fields, so an older console can read a newer agent."""

from enum import StrEnum
from typing import Any

from msgspec import Struct

from device_agent.protocol.fields import Count, Id, Label, Milliseconds, Text


class AckStatus(StrEnum):
    """Progress of a command. The last four values are terminal."""

    RECEIVED = "received"
    ACCEPTED = "accepted"
    STARTED = "started"
    DONE = "done"
    FAILED = "failed"
    EXPIRED = "expired"
    CANCELLED = "cancelled"

    @property
    def terminal(self) -> bool:
        """Whether no further acknowledgement follows."""
        return self in TERMINAL


TERMINAL = frozenset({AckStatus.DONE, AckStatus.FAILED, AckStatus.EXPIRED, AckStatus.CANCELLED})


class Reason(Struct, frozen=True, kw_only=True):
    """Why a command ended: a code for programs, and a message for people that names the remedy."""

    code: Label
    message: Text


class Ack(Struct, frozen=True, kw_only=True):
    """``ack``: the device's response to one command. ``sequence`` orders the acknowledgements of one command."""

    id: Id
    status: AckStatus
    sequence: Count
    at_ms: Milliseconds
    tick_ms: Milliseconds
    reason: Reason | None = None
    progress: float | None = None
    output: Text = ""
    result: dict[str, Any] = {}
