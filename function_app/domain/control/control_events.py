"""Events about control of a device: acquired, released, requested, stopped, rejected.

They record decisions of the cloud; the agent reports their effects in its own events. Event ids derive from the lease,
so a repeated event is stored once.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Literal

from function_app.domain.control.lease import ControlRequest, Lease


class Fact(StrEnum):
    """Kinds of control events."""

    TAKEN = "control-taken"
    TAKEN_OVER = "control-taken-over"
    HANDED_OVER = "control-handed-over"
    RELEASED = "control-released"
    EXPIRED = "control-expired"
    ENDED = "control-ended"
    REQUESTED = "control-requested"
    REQUEST_DENIED = "control-request-denied"
    REQUEST_WITHDRAWN = "control-request-withdrawn"
    REQUEST_EXPIRED = "control-request-expired"
    STOP_ORDERED = "stop-ordered"
    RESET_ORDERED = "stop-reset-ordered"
    COMMAND_REJECTED = "command-rejected"
    SHARED = "shared"
    UNSHARED = "unshared"


@dataclass(frozen=True, slots=True)
class ControlEvent:
    """One event. ``id`` is unique for the device; ``data`` is for programs, ``message`` for people."""

    id: str
    fact: Fact
    at_ms: int
    message: str
    data: dict[str, Any] = field(default_factory=dict)
    severity: Literal["info", "warning"] = "info"

    def event(self, device_name: str) -> dict[str, Any]:
        """The event as stored among the device's events."""
        return {
            "id": self.id,
            "device": device_name,
            "at_ms": self.at_ms,
            "kind": self.fact.value,
            "severity": self.severity,
            "message": self.message,
            "data": self.data,
        }


def timed_out(lease: Lease, now_ms: int) -> Iterator[ControlEvent]:
    """Transitions due to timeouts: an expired lease, an unanswered request."""
    request = lease.request
    if request is not None and request.outcome == "open" and request.current_outcome(lease, now_ms) == "expired":
        yield _of_request(
            request, Fact.REQUEST_EXPIRED, request.expires_ms, f"The control request of {request.by} expired."
        )
    if lease.account and not lease.action and not lease.is_live(now_ms):
        message = f"The lease of {lease.holder} expired."
        yield _of_lease(lease, Fact.EXPIRED, lease.expires_ms, message, {"holder": lease.holder})


def lease_changes(before: Lease | None, after: Lease, *, by: str, now_ms: int) -> Iterator[ControlEvent]:
    """The events that one write of the lease causes; ``by`` is the name of the account that changed it."""
    if before is not None and (after.epoch != before.epoch or not after.account):
        yield from timed_out(before, now_ms)
    elif (
        before is not None
        and before.request is not None
        and (after.request is None or after.request.id != before.request.id)
    ):
        yield from (late for late in timed_out(before, now_ms) if late.fact is Fact.REQUEST_EXPIRED)
    yield from _of_change(before, after, by=by, now_ms=now_ms)
    yield from _of_request_change(before, after, by=by, now_ms=now_ms)


def control_ended(before: Lease, after: Lease, *, why: str, now_ms: int) -> ControlEvent:
    """The event for control that ended because the device was ``unpaired``, ``moved``, ``removed`` or ``unshared``."""
    how = "is no longer shared with them" if why == "unshared" else f"was {why}"
    message = f"Control of {before.holder} ended: the device {how}."
    data: dict[str, str | int] = {"holder": before.holder, "reason": why, "ended_epoch": before.epoch}
    return _of_lease(after, Fact.ENDED, now_ms, message, data)


def _of_change(before: Lease | None, after: Lease, *, by: str, now_ms: int) -> Iterator[ControlEvent]:
    previous = before.holder if before is not None and before.is_live(now_ms) else ""
    if before is not None and after.epoch == before.epoch:
        if previous and not after.account and not before.action:
            yield _of_lease(after, Fact.RELEASED, now_ms, f"{by} released control.", {"holder": previous})
        return
    data = {"holder": after.holder} | ({"from": previous} if previous else {})
    request = after.request
    if not after.account:
        ended = {"ended_epoch": before.epoch} if before is not None and previous else {}
        yield _of_lease(after, Fact.RESET_ORDERED, now_ms, f"{by} reset the Stop.", {"caller": by, **data, **ended})
    elif request is not None and request.outcome == "accepted" and request.epoch == after.epoch - 1:
        message = f"{by} handed control over to {after.holder}."
        yield _of_lease(after, Fact.HANDED_OVER, now_ms, message, {"request": request.id, **data})
    elif after.reason:
        message = f"{after.holder} took control from {previous}: {after.reason}"
        data = {"reason": after.reason, **data}
        yield _of_lease(after, Fact.TAKEN_OVER, now_ms, message, data, severity="warning")
    else:
        data |= {"action": after.action} if after.action else {}
        yield _of_lease(after, Fact.TAKEN, now_ms, f"{after.holder} took control.", data)


def _of_request_change(before: Lease | None, after: Lease, *, by: str, now_ms: int) -> Iterator[ControlEvent]:
    request, existing = after.request, before.request if before is not None else None
    if request is None or request == existing:
        return
    if request.outcome == "open":
        message = f"{request.by} requested control from {after.holder}."
        yield _of_request(request, Fact.REQUESTED, now_ms, message)
    elif request.outcome == "rejected":
        yield _of_request(
            request, Fact.REQUEST_DENIED, now_ms, f"{by} rejected the request of {request.by} for control."
        )
    elif request.outcome == "withdrawn":
        yield _of_request(request, Fact.REQUEST_WITHDRAWN, now_ms, f"{request.by} withdrew the control request.")


def _of_lease(
    lease: Lease,
    fact: Fact,
    at_ms: int,
    message: str,
    data: Mapping[str, str | int],
    *,
    severity: Literal["info", "warning"] = "info",
) -> ControlEvent:
    return ControlEvent(f"{fact}-{lease.epoch}", fact, at_ms, message, {"epoch": lease.epoch, **data}, severity)


def _of_request(request: ControlRequest, fact: Fact, at_ms: int, message: str) -> ControlEvent:
    data = {"request": request.id, "requester": request.by, "epoch": request.epoch}
    return ControlEvent(f"{fact}-{request.id}", fact, at_ms, message, data)
