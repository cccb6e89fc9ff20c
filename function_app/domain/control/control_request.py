"""Requests for control, which the holder accepts or rejects, the requester withdraws, or which time out.

The request is part of the lease's row, so one write decides both. A timeout never transfers control. A request refers
to one epoch and ends with it: a released or expired lease is free and is not assigned automatically.
"""

from dataclasses import replace

from function_app.domain.common.problems import Problem, forbidden, not_found
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.control.lease import ControlRequest, Lease, Outcome
from function_app.domain.identity.accounts import Identity


def request_control(
    lease: Lease | None, caller: Identity, *, request: str, within_ms: int, lease_ms: int, now_ms: int
) -> Lease:
    """The lease with a request of ``caller``; unchanged if the caller's request is already open.

    Raises ``lease-free``, ``lease-already-held``, or ``lease-requested``: another request is open.
    """
    if lease is None or not lease.is_live(now_ms):
        detail = "No session controls this device. Acquire the lease; no request is needed."
        raise Problem("lease-free", 409, "The lease is free", detail)
    if lease.held_by(caller):
        detail = "This session already controls the device."
        raise Problem("lease-already-held", 409, "The lease is yours", detail, extras={"epoch": lease.epoch})
    existing = lease.request
    if existing is not None and existing.current_outcome(lease, now_ms) == "open":
        if existing.requested_by(caller):
            return lease
        expires_at = rfc3339(existing.expires_ms)
        detail = f"{existing.by} has already requested control. Wait for the response, or until {expires_at}."
        extras = {"requester": existing.by, "expires_at": expires_at}
        raise Problem("lease-requested", 409, "Another request is open", detail, extras=extras)
    control_request = ControlRequest(
        id=request,
        epoch=lease.epoch,
        account=caller.account,
        session=caller.session,
        by=caller.name,
        holder_account=lease.account,
        holder_session=lease.session,
        requested_ms=now_ms,
        expires_ms=now_ms + within_ms,
        lease_ms=lease_ms,
    )
    return replace(lease, request=control_request)


def accept(lease: Lease | None, caller: Identity, *, request: str, now_ms: int) -> Lease:
    """The lease of the requester with the next epoch; unchanged if already accepted.

    Raises ``request-unknown``, ``forbidden`` or ``control-request-closed``.
    """
    current, control_request = _find_for_holder(lease, caller, request)
    if not _is_open(current, control_request, "accepted", now_ms):
        return current
    return Lease(
        epoch=current.epoch + 1,
        account=control_request.account,
        session=control_request.session,
        holder=control_request.by,
        expires_ms=now_ms + control_request.lease_ms,
        lease_ms=control_request.lease_ms,
        pairing=current.pairing,
        request=replace(control_request, outcome="accepted"),
    )


def reject(lease: Lease | None, caller: Identity, *, request: str, now_ms: int) -> Lease:
    """The lease with the request rejected; unchanged if already rejected.

    Raises ``request-unknown``, ``forbidden`` or ``control-request-closed``.
    """
    current, control_request = _find_for_holder(lease, caller, request)
    if not _is_open(current, control_request, "rejected", now_ms):
        return current
    return replace(current, request=replace(control_request, outcome="rejected"))


def withdraw(lease: Lease | None, caller: Identity, *, request: str, now_ms: int) -> Lease:
    """The lease with the request withdrawn; unchanged if it already ended, unless it was accepted.

    Raises ``request-unknown``, ``forbidden`` or ``control-request-closed``.
    """
    current, control_request = find(lease, request)
    if not control_request.requested_by(caller):
        raise forbidden("Only the session that requested control may withdraw the request.")
    outcome = control_request.current_outcome(current, now_ms)
    if outcome == "accepted":
        raise _closed(outcome)
    if outcome != "open":
        return current
    return replace(current, request=replace(control_request, outcome="withdrawn"))


def find(lease: Lease | None, request: str) -> tuple[Lease, ControlRequest]:
    """The lease and the request with this id. The last request can be read after it has ended.

    Raises ``request-unknown``.
    """
    if lease is None or lease.request is None or lease.request.id != request:
        raise not_found("request", request)
    return lease, lease.request


def _find_for_holder(lease: Lease | None, caller: Identity, request: str) -> tuple[Lease, ControlRequest]:
    current, control_request = find(lease, request)
    if not control_request.addressed_to(caller):
        raise forbidden("Only the session that holds the lease may answer the request.")
    return current, control_request


def _is_open(lease: Lease, control_request: ControlRequest, answer: Outcome, now_ms: int) -> bool:
    """Whether the request can still be answered; ``False`` if it already has this answer."""
    outcome = control_request.current_outcome(lease, now_ms)
    if outcome not in {"open", answer}:
        raise _closed(outcome)
    return outcome == "open"


_ENDS: dict[Outcome, str] = {
    "accepted": "It was accepted: the requester has control.",
    "rejected": "It was rejected: control did not change.",
    "withdrawn": "The requester has withdrawn it.",
    "expired": "It timed out: control did not change. Send a new request if needed.",
    "ended": "The requested lease has ended. Check who has control now.",
}


def _closed(outcome: Outcome) -> Problem:
    detail = _ENDS[outcome]
    return Problem("control-request-closed", 409, "The request is closed", detail, extras={"outcome": outcome})
