"""Acknowledgements of commands by devices, and of stored messages by the cloud.

Readers ignore unknown fields, so an older console can read a newer agent.
"""

import hashlib
from enum import StrEnum
from typing import Annotated, Any

from msgspec import UNSET, Meta, Struct, UnsetType

from device_agent.protocol.fields import Count, Id, Label, Milliseconds, Text, TraceParent


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
    """Why a command ended: a code for programs, and a message for people that names the remedy.

    ``epoch``: highest epoch that the device has seen, if it rejected the command because of its epoch; otherwise 0.
    """

    code: Label
    message: Text
    epoch: Count = 0


class Ack(Struct, frozen=True, kw_only=True):
    """``ack``: the device's response to one command. ``sequence`` orders the acknowledgements of one command.

    ``traceparent``: the device's span, if the command is traced.
    """

    id: Id
    status: AckStatus
    sequence: Count
    at_ms: Milliseconds
    tick_ms: Milliseconds
    reason: Reason | None = None
    progress: float | None = None
    output: Text = ""
    result: dict[str, Any] = {}
    traceparent: TraceParent | UnsetType = UNSET


class Verdict(StrEnum):
    """How a trial ended. ``UNKNOWN``: its end was not observed."""

    SUCCESS = "success"
    FAILED = "failed"
    UNKNOWN = "unknown"


class TrialCause(StrEnum):
    """Why a trial has no success; ``NONE`` after a success."""

    NONE = ""
    NOT_MET = "not_met"
    """The condition of the task was not met at the end."""
    INCOMPLETE = "incomplete"
    """The robot has lifted the object or moved the part, but the condition was not met: dropped, held or elsewhere."""
    TIME_LIMIT = "time_limit"
    """The time limit of the task passed."""
    MOVEMENT_FAILED = "movement_failed"
    """The movement or the device failed."""
    STOPPED = "stopped"
    """A person, an interlock or the loss of control ended the trial."""
    LOST = "lost"
    """The link, the agent or the monitor ended before the trial; or nothing was reported."""
    NOT_STARTED = "not_started"
    """The objects were not reset, so the movement did not run."""


class TrialReport(Struct, frozen=True, kw_only=True):
    """Entry ``trial`` in the result of ``run_trial``: the verdict of the monitor. A script cannot write it.

    Attributes:
        detail: The cause in words, for operators.
        duration_s: From the reset to the verdict, on the clock of the monitor [s]; simulated time in a simulation.
        simulated: Whether the device is simulated.
        software: Release of the agent.
        type_version: Version of the robot type at the agent.
    """

    verdict: Verdict
    cause: TrialCause = TrialCause.NONE
    detail: Text = ""
    duration_s: float = 0.0
    simulated: bool = False
    software: Label = ""
    type_version: Count = 0


MessageId = Annotated[str, Meta(pattern="^[0-9a-f]{24}$", description="BLAKE2b of topic + line feed + payload")]
MAX_IDS = 1000
"""Maximum number of ids in one ``Stored`` message: 27 KB."""


class Stored(Struct, frozen=True, kw_only=True):
    """``stored``: messages of a device that the cloud has stored, or will never accept."""

    ids: Annotated[tuple[MessageId, ...], Meta(min_length=1, max_length=MAX_IDS)]


def message_id(topic: str, payload: bytes) -> str:
    """The id of a message: both sides compute it from the exact bytes, so it needs no field and no parsing."""
    return hashlib.blake2b(topic.encode() + b"\n" + payload, digest_size=12).hexdigest()
