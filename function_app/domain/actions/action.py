"""The life cycle of an action.

``created → published → received → accepted → started → done | failed | expired | cancelled``; a waiting action is first
``queued``. Steps may be skipped but not reversed. The first terminal status is final.

If the device does not report in time, the action is ``unknown``: the device may have executed it. The device's report
ends it, also days later.
"""

from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Self

from function_app.domain.common.timestamps import CLOCK_SKEW_MS

_TERMINAL_RANK = 6


class Status(StrEnum):
    """The progress of an action. The last four values are terminal; ``UNKNOWN`` frees the device but is not.

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
    UNKNOWN = "unknown", 5
    DONE = "done", _TERMINAL_RANK
    FAILED = "failed", _TERMINAL_RANK
    EXPIRED = "expired", _TERMINAL_RANK
    CANCELLED = "cancelled", _TERMINAL_RANK


RETRY_MS = 1_000
"""Interval after which an unacknowledged command is published again."""
GRACE_MS = 3_000
"""Allowed delay of an ack. Then the outcome is unknown."""
ASK_MS = 30_000
"""Longest interval at which the device is asked for the outcome."""
JOURNAL_MS = 7 * 24 * 3_600_000
"""Agents store the outcome of a command at least for this time after its issue. Then the outcome is lost.

Without this limit, an agent that has deleted the outcome would report an executed command as expired.
"""

UNSHARED = "unshared"
KEY_ENDED = "api-key-ended"
SIGNED_OUT = "signed-out"
WITHDRAWN = frozenset({UNSHARED, KEY_ENDED, SIGNED_OUT})
"""Codes of ``withdraw``."""
LOST = "lost"
NO_REPORT = (
    "The device has not reported how the action ended; it may have executed it. Check the device. The result appears "
    "here when the device reports it."
)


@dataclass(frozen=True, slots=True)
class Action:
    """One execution of an operation on one device.

    Attributes:
        request: The request as received.
        pinned: For a movement: version and SHA-256 of the script, so that a republished command is identical.
        pairing: Pairing of the agent.
        session: Sign-in session that started it; its own lease belongs to this session.
        epoch: Epoch of its lease; 0 while queued without a lease.
        timeout_ms: Time from its start in the slot to ``deadline_ms``.
        queued_until_ms: End of the queueing time [ms since 1970]; 0: was never queued.
        turn_ms: When it left the queue [ms since 1970].
        times: Status → time [ms since 1970]; ``published`` by the cloud clock, later ones by the agent clock.
        received: Status → time of reception in the cloud, by the cloud clock [ms since 1970].
        sequence: Sequence number of the newest ack.
        cancel_id: Id of the command that cancels it; empty: not cancelled.
        idempotency_key: Key of the row with its idempotency key, or empty.
        reissuable: Whether its command may be issued once more with a higher epoch: the request named no epoch.
        traceparent: The request's span, for its command; empty: not traced.
    """

    id: str
    device: str
    account: str
    caller: str
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
    idempotency_key: str = ""
    received: dict[str, int] = field(default_factory=dict)
    session: str = ""
    timeout_ms: int = 0
    queued_until_ms: int = 0
    turn_ms: int = 0
    reissuable: bool = False
    traceparent: str = ""

    @property
    def issued_ms(self) -> int:
        """When its command was issued [ms since 1970]; equal for republished commands."""
        return self.turn_ms or self.created_ms

    @property
    def ended_ms(self) -> int:
        """When it ended [ms since 1970], limited to plausible times because agent clocks may be wrong."""
        return max(min(self.times.get(self.status.value, self.created_ms), self.deadline_ms), self.created_ms)

    @property
    def expires_ms(self) -> int:
        """From this time on the device must not start it."""
        return self.issued_ms + self.ttl_ms


@dataclass(frozen=True, slots=True)
class AckReport:
    """An ack of an action. ``output`` is the complete output of the script so far.

    ``received_ms``: reception in the cloud, by the cloud clock [ms since 1970]; 0: unknown. ``device_epoch``: highest
    epoch of the device, if it rejected the command because of its epoch; otherwise 0.
    """

    status: Status
    sequence: int
    at_ms: int
    reason: dict[str, str] | None = None
    progress: float | None = None
    output: str = ""
    result: dict[str, Any] = field(default_factory=dict)
    received_ms: int = 0
    device_epoch: int = 0


def apply_report(action: Action, report: AckReport) -> Action:
    """The action after an ack. Duplicate, late and reordered acks never revert a step."""
    if action.status is Status.QUEUED or (action.status.terminal and not is_lost(action)):
        return action  # a queued action was never sent, so this ack is not genuine
    if report.status is Status.EXPIRED and action.cancel_id:
        reason = {"code": "cancelled", "message": "Cancelled before the device received it."}
        report = replace(report, status=Status.CANCELLED, reason=reason)
    by_request = report.status is Status.CANCELLED and action.cancel_id
    if report.status.terminal and report.status is not Status.DONE and is_withdrawn(action) and not by_request:
        report = replace(report, status=Status.FAILED, reason=action.reason)
    if 0 < report.device_epoch < action.epoch:
        return action  # the rejected command was issued again with a higher epoch
    times = action.times if report.status.value in action.times else {**action.times, report.status.value: report.at_ms}
    received, first_ms = action.received, action.received.get(report.status.value)
    if report.received_ms and (first_ms is None or report.received_ms < first_ms):
        # Several processes may receive the same ack: the earliest time counts.
        received = {**received, report.status.value: report.received_ms}
    if report.sequence <= action.sequence and report.status.rank <= action.status.rank:
        same = times is action.times and received is action.received
        return action if same else replace(action, times=times, received=received)
    newest = report.sequence > action.sequence or report.status.terminal
    doubt = report.status.terminal and (action.status is Status.UNKNOWN or is_lost(action))
    return replace(
        action,
        times=times,
        received=received,
        sequence=max(action.sequence, report.sequence),
        status=report.status if report.status.rank >= action.status.rank else action.status,
        progress=report.progress if newest and report.progress is not None else action.progress,
        output=(newest and report.output) or action.output,
        result=(newest and report.result) or action.result,
        reason=(newest and report.reason) or (None if doubt else action.reason),
    )


def mark_published(action: Action, now_ms: int) -> Action:
    """The action, marked as published; the same object if already marked. An ack may be stored earlier."""
    if Status.PUBLISHED.value in action.times:
        return action
    status = Status.PUBLISHED if action.status is Status.CREATED else action.status
    return replace(action, status=status, times={**action.times, Status.PUBLISHED.value: now_ms})


def give_turn(action: Action, epoch: int, now_ms: int) -> Action:
    """The action when it leaves the queue: its time to live and time limit start."""
    times = {**action.times, Status.CREATED.value: now_ms}
    deadline_ms = now_ms + action.timeout_ms
    return replace(action, status=Status.CREATED, epoch=epoch, turn_ms=now_ms, deadline_ms=deadline_ms, times=times)


def may_reissue(action: Action, device_epoch: int) -> bool:
    """Whether the command, which the device rejected because of its epoch, may be issued with a higher one."""
    open_ = not action.status.terminal and action.status is not Status.UNKNOWN
    return action.reissuable and open_ and device_epoch >= action.epoch > 0


def reissue(action: Action, epoch: int, now_ms: int) -> Action:
    """The action when its rejected command is issued once more."""
    rejected = replace(action, times={}, received={}, sequence=-1, reissuable=False)
    return give_turn(rejected, epoch, now_ms)


def end(action: Action, status: Status, code: str, message: str, now_ms: int) -> Action:
    """The action, ended by the cloud, or with an unknown outcome; the same object if it has already ended."""
    if action.status.terminal:
        return action
    return replace(
        action, status=status, times={**action.times, status.value: now_ms}, reason={"code": code, "message": message}
    )


def withdraw(action: Action, code: str, message: str, now_ms: int) -> Action:
    """The action after its account lost the right to run it. It is cancelled at the device, which may have executed it.

    Its outcome is unknown until the device reports: ``done``, ``cancelled`` if its caller had cancelled it before, or
    ``failed`` with this reason.
    """
    return action if action.status is Status.UNKNOWN else end(action, Status.UNKNOWN, code, message, now_ms)


def is_withdrawn(action: Action) -> bool:
    """Whether its account lost the right to run it, and the device has not reported its end."""
    return action.status is Status.UNKNOWN and action.reason is not None and action.reason["code"] in WITHDRAWN


def is_lost(action: Action) -> bool:
    """Whether the cloud ended it without a report. A report that arrives nevertheless replaces this end."""
    return action.status.terminal and action.reason is not None and action.reason["code"] == LOST


def reached(action: Action, status: Status) -> bool:
    """Whether the action has reached ``status``, or can no longer reach it because it has ended."""
    if action.status is Status.UNKNOWN:
        return status.value in action.times
    return action.status.terminal or action.status.rank >= status.rank


def next_check_ms(action: Action, now_ms: int) -> int:
    """When the timer must check an open action again [ms since 1970]."""
    if action.status is Status.QUEUED:
        return action.queued_until_ms
    if action.status is Status.UNKNOWN:
        since_ms = action.times[Status.UNKNOWN.value]
        return min(now_ms + min(max(now_ms - since_ms, RETRY_MS), ASK_MS), action.issued_ms + JOURNAL_MS)
    if action.status.rank < Status.RECEIVED.rank or now_ms >= action.deadline_ms:
        return now_ms + RETRY_MS
    return action.deadline_ms


def after_set_back(action: Action, now_ms: int) -> Action:
    """The action with time limits that start now, if the cloud's clock was set back since they were written.

    The same object if its limits are plausible. When the command was issued does not change, because republished
    commands are equal.
    """
    if action.status is Status.QUEUED:
        ahead_ms = action.created_ms - now_ms
        if ahead_ms <= CLOCK_SKEW_MS:
            return action
        return replace(
            action,
            created_ms=now_ms,
            queued_until_ms=action.queued_until_ms - ahead_ms,
            deadline_ms=action.deadline_ms - ahead_ms,
        )
    if action.status is Status.UNKNOWN:
        since_ms = action.times[Status.UNKNOWN.value]
        times = {**action.times, Status.UNKNOWN.value: now_ms}
        return replace(action, times=times) if since_ms > now_ms + CLOCK_SKEW_MS else action
    limit_ms = now_ms + action.timeout_ms
    if action.status.terminal or action.deadline_ms <= limit_ms + CLOCK_SKEW_MS:
        return action
    return replace(action, deadline_ms=limit_ms)


class NextStep(StrEnum):
    """What the timer must do with an open action.

    Attributes:
        ASK: Publish the command again though it has expired: the device does not start it, but repeats its last ack.
        DOUBT: The outcome is unknown.
        LOSE: The outcome will never be known.
    """

    WAIT = "wait"
    PUBLISH = "publish"
    CANCEL = "cancel"
    ASK = "ask"
    DOUBT = "doubt"
    EXPIRE = "expire"
    LOSE = "lose"
    ENDED = "ended"


def next_step(action: Action, now_ms: int) -> NextStep:
    """The next step of the timer. An unacknowledged command is republished; the device drops duplicates by id.

    After a cancellation the cancel command is republished instead, until the time to live ends. At its deadline the
    action is cancelled.
    """
    if action.status.terminal:
        return NextStep.ENDED
    if action.status is Status.QUEUED:
        return NextStep.EXPIRE if now_ms >= action.queued_until_ms else NextStep.WAIT
    if action.status is Status.UNKNOWN:
        if now_ms < min(action.expires_ms, action.times[Status.UNKNOWN.value] + action.ttl_ms):
            return NextStep.CANCEL  # the device would start it
        return NextStep.LOSE if now_ms >= action.issued_ms + JOURNAL_MS else NextStep.ASK
    return _step_in_slot(action, now_ms)


def _step_in_slot(action: Action, now_ms: int) -> NextStep:
    acknowledged = action.status.rank >= Status.RECEIVED.rank
    limit_ms = action.deadline_ms if acknowledged else action.expires_ms
    set_back = not acknowledged and action.issued_ms > now_ms + CLOCK_SKEW_MS
    if set_back or now_ms >= limit_ms + GRACE_MS:
        return NextStep.DOUBT  # after the clock was set back it is not known whether the time to live has ended
    if now_ms >= limit_ms:
        return NextStep.CANCEL if acknowledged else NextStep.ASK
    if acknowledged:
        return NextStep.WAIT
    return NextStep.CANCEL if action.cancel_id else NextStep.PUBLISH
