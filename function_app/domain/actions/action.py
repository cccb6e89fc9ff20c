"""An action's life: ``created → published → received → accepted → started → done | failed | expired | cancelled``.

One that waits for its turn is ``queued`` before. Steps may be skipped, never taken back. The first terminal state
stays, whoever reports another one later.
"""

from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Self

_TERMINAL_RANK = 5


class Status(StrEnum):
    """The progress of an action. The last four values are terminal.

    Attributes:
        rank: Position in the order; all terminal states share the last one.
        terminal: No other status follows.
    """

    rank: int
    terminal: bool

    def __new__(cls, value: str, rank: int = 0) -> Self:  # noqa: D102 (attributes instead of properties: read per ack)
        member = str.__new__(cls, value)
        member._value_ = value
        member.rank = rank
        member.terminal = rank == _TERMINAL_RANK
        return member

    QUEUED = "queued", -1
    CREATED = "created", 0
    PUBLISHED = "published", 1
    RECEIVED = "received", 2
    ACCEPTED = "accepted", 3
    STARTED = "started", 4
    DONE = "done", _TERMINAL_RANK
    FAILED = "failed", _TERMINAL_RANK
    EXPIRED = "expired", _TERMINAL_RANK
    CANCELLED = "cancelled", _TERMINAL_RANK


RETRY_MS = 1_000
"""A command that nobody has answered is published again after this time."""
GRACE_MS = 3_000
"""An ack may be this late: until then a command whose time ran out is not called expired."""


@dataclass(frozen=True, slots=True)
class Action:
    """One run of something on one device.

    Attributes:
        request: What was asked, as it was asked.
        pinned: For a movement: version and SHA-256 of the script, so that a re-published command is the same one.
        pairing: The agent's pairing that it belongs to.
        session: The sign-in session that started it: a lease for it will be that session's.
        epoch: Of its lease; 0 while it waits for its turn and was started without one.
        timeout_ms: From its turn to ``deadline_ms``.
        queued_until_ms: As long as it may wait for its turn [ms since 1970]; 0 for one that never waited.
        turn_ms: When its turn came, for one that has waited [ms since 1970].
        times: Status → when [ms since 1970]; ``published`` by the cloud's clock, the later ones by the agent's.
        heard: Status → when the cloud heard of it, by its own clock [ms since 1970].
        sequence: Of the newest ack seen.
        cancel_id: Of the command that shall end it, once somebody wants that.
        once: Key of the row that holds the idempotency key it was started with, or empty.
    """

    id: str
    device: str
    account: str
    who: str
    pairing: str
    request: dict[str, Any]
    epoch: int
    created_ms: int
    ttl_ms: int
    deadline_ms: int
    status: Status = Status.CREATED
    pinned: dict[str, Any] = field(default_factory=dict)
    times: dict[str, int] = field(default_factory=dict)
    reason: dict[str, str] | None = None
    progress: float | None = None
    output: str = ""
    result: dict[str, Any] = field(default_factory=dict)
    sequence: int = -1
    cancel_id: str = ""
    once: str = ""
    heard: dict[str, int] = field(default_factory=dict)
    session: str = ""
    timeout_ms: int = 0
    queued_until_ms: int = 0
    turn_ms: int = 0

    @property
    def issued_ms(self) -> int:
        """When its command was issued [ms since 1970]: a repeated one says the same."""
        return self.turn_ms or self.created_ms

    @property
    def ended_ms(self) -> int:
        """When it ended, as far as that can be believed [ms since 1970]: an agent's clock may be anywhere."""
        return min(max(self.times.get(self.status.value, self.created_ms), self.created_ms), self.deadline_ms)

    @property
    def expires_ms(self) -> int:
        """From here on the device must not begin it any more."""
        return self.issued_ms + self.ttl_ms


@dataclass(frozen=True, slots=True)
class AckReport:
    """One ack about an action. ``output`` is all the script has printed so far, not what is new.

    ``heard_ms`` is when it was heard, by the cloud's clock [ms since 1970]; 0: nobody has looked.
    """

    status: Status
    sequence: int
    at_ms: int
    reason: dict[str, str] | None = None
    progress: float | None = None
    output: str = ""
    result: dict[str, Any] = field(default_factory=dict)
    heard_ms: int = 0


def apply_report(action: Action, report: AckReport) -> Action:
    """The action after a report: the same object when it brings nothing new.

    Idempotent and monotone: doubled, late and disordered reports never take a step back.
    """
    if action.status.terminal or action.status is Status.QUEUED:
        return action  # a queued one was never sent: whoever reports about it makes it up
    times = action.times if report.status.value in action.times else {**action.times, report.status.value: report.at_ms}
    heard, first_ms = action.heard, action.heard.get(report.status.value)
    if report.heard_ms and (first_ms is None or report.heard_ms < first_ms):
        # Several processes may receive the same ack: the earliest time counts.
        heard = {**heard, report.status.value: report.heard_ms}
    if report.sequence <= action.sequence and report.status.rank <= action.status.rank:
        same = times is action.times and heard is action.heard
        return action if same else replace(action, times=times, heard=heard)
    newest = report.sequence > action.sequence or report.status.terminal
    return replace(
        action,
        times=times,
        heard=heard,
        sequence=max(action.sequence, report.sequence),
        status=report.status if report.status.rank >= action.status.rank else action.status,
        progress=report.progress if newest and report.progress is not None else action.progress,
        output=(newest and report.output) or action.output,
        result=(newest and report.result) or action.result,
        reason=(newest and report.reason) or action.reason,
    )


def mark_published(action: Action, now_ms: int) -> Action:
    """The action, published; the same object when that is known. A device's ack may be written down before this is."""
    if Status.PUBLISHED.value in action.times:
        return action
    status = Status.PUBLISHED if action.status is Status.CREATED else action.status
    return replace(action, status=status, times={**action.times, Status.PUBLISHED.value: now_ms})


def give_turn(action: Action, epoch: int, now_ms: int) -> Action:
    """A queued action that is to be sent now: its time to live and its time limit begin."""
    times = {**action.times, Status.CREATED.value: now_ms}
    deadline_ms = now_ms + action.timeout_ms
    return replace(action, status=Status.CREATED, epoch=epoch, turn_ms=now_ms, deadline_ms=deadline_ms, times=times)


def end(action: Action, status: Status, code: str, message: str, now_ms: int) -> Action:
    """The action, ended by the cloud; the same object when it already has an end."""
    if action.status.terminal:
        return action
    return replace(
        action,
        status=status,
        times={**action.times, status.value: now_ms},
        reason={"code": code, "message": message},
    )


def reached(action: Action, wanted: Status) -> bool:
    """Whether waiting for ``wanted`` is over."""
    return action.status.terminal or action.status.rank >= wanted.rank


def next_check_ms(action: Action, now_ms: int) -> int:
    """When a timer has to look at an open action again [ms since 1970]."""
    if action.status is Status.QUEUED:
        return action.queued_until_ms
    if action.status.rank < Status.RECEIVED.rank and now_ms < action.expires_ms + GRACE_MS:
        return min(now_ms + RETRY_MS, action.deadline_ms)
    return action.deadline_ms


class NextStep(StrEnum):
    """What a timer has to do about an open action."""

    WAIT = "wait"
    PUBLISH = "publish"
    CANCEL = "cancel"
    EXPIRE = "expire"
    LOSE = "lose"
    ENDED = "ended"


def next_step(action: Action, now_ms: int) -> NextStep:
    """What is due. An unanswered command is sent again until its time to live ends: the device drops doubles by id.

    Once somebody wants it cancelled, that is what is sent again: it must not begin because a message was lost.
    """
    if action.status.terminal:
        return NextStep.ENDED
    if action.status is Status.QUEUED:
        return NextStep.EXPIRE if now_ms >= action.queued_until_ms else NextStep.WAIT
    if now_ms >= action.deadline_ms:
        return NextStep.LOSE
    if action.status.rank < Status.RECEIVED.rank:
        if now_ms < action.expires_ms:
            return NextStep.CANCEL if action.cancel_id else NextStep.PUBLISH
        if now_ms >= action.expires_ms + GRACE_MS:
            return NextStep.EXPIRE
    return NextStep.WAIT
