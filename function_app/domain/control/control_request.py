"""Asking for control: a request that the holder accepts or refuses, that who asks withdraws, or that lapses.

It is part of the lease's row, so one write decides what becomes of both, and of all that happens at once one thing
does. Silence takes control from nobody. A request asks for one epoch and ends with it: a lease that is released or runs
out is free, and given to nobody by itself, so that nothing begins in the moment in which somebody lets go.
"""

from dataclasses import replace

from function_app.domain.common.problems import Problem, forbidden, not_found
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.control.lease import ControlRequest, Lease, Outcome
from function_app.domain.identity.accounts import Identity


def request_control(
    lease: Lease | None, caller: Identity, *, request: str, within_ms: int, lease_ms: int, now_ms: int
) -> Lease:
    """The lease with a request of ``caller``; as it is when they ask already.

    Raises:
        Problem: ``lease-free``, ``lease-already-held``, ``lease-requested``: somebody else was first.
    """
    if lease is None or not lease.is_live(now_ms):
        detail = "Nobody controls this device. Take the lease; there is nobody to ask."
        raise Problem("lease-free", 409, "Nobody holds the lease", detail)
    if lease.held_by(caller):
        detail = "You control this device already, in this very session."
        raise Problem("lease-already-held", 409, "The lease is yours", detail, extras={"epoch": lease.epoch})
    existing = lease.request
    if existing is not None and existing.current_outcome(lease, now_ms) == "open":
        if existing.requested_by(caller):
            return lease
        detail = (
            f"{existing.by} asks for control already. Wait for the answer, or until {rfc3339(existing.expires_ms)}."
        )
        extras = {"requester": existing.by, "expires_at": rfc3339(existing.expires_ms)}
        raise Problem("lease-requested", 409, "Somebody else asks already", detail, extras=extras)
    asked = ControlRequest(
        id=request,
        epoch=lease.epoch,
        account=caller.account,
        session=caller.session,
        by=caller.name,
        holder_account=lease.account,
        holder_session=lease.session,
        asked_ms=now_ms,
        expires_ms=now_ms + within_ms,
        lease_ms=lease_ms,
    )
    return replace(lease, request=asked)


def accept(lease: Lease | None, caller: Identity, *, request: str, now_ms: int) -> Lease:
    """The lease of whoever asked, with the next epoch; as it is when that was done already.

    Raises:
        Problem: ``request-unknown``, ``forbidden``, ``control-request-closed``.
    """
    current, asked = _to_answer(lease, caller, request)
    if not _still(current, asked, "accepted", now_ms):
        return current
    return Lease(
        epoch=current.epoch + 1,
        account=asked.account,
        session=asked.session,
        holder=asked.by,
        expires_ms=now_ms + asked.lease_ms,
        lease_ms=asked.lease_ms,
        pairing=current.pairing,
        request=replace(asked, outcome="accepted"),
    )


def refuse(lease: Lease | None, caller: Identity, *, request: str, now_ms: int) -> Lease:
    """The lease as it is, the request refused; the same when that was done already.

    Raises:
        Problem: ``request-unknown``, ``forbidden``, ``control-request-closed``.
    """
    current, asked = _to_answer(lease, caller, request)
    if not _still(current, asked, "rejected", now_ms):
        return current
    return replace(current, request=replace(asked, outcome="rejected"))


def withdraw(lease: Lease | None, caller: Identity, *, request: str, now_ms: int) -> Lease:
    """The lease as it is, the request gone; the same when it was over already, unless it was accepted.

    Raises:
        Problem: ``request-unknown``, ``forbidden``, ``control-request-closed``.
    """
    current, asked = find(lease, request)
    if not asked.requested_by(caller):
        raise forbidden("Only who asked for control may withdraw that, in the same session.")
    how = asked.current_outcome(current, now_ms)
    if how == "accepted":
        raise _over(how)
    if how != "open":
        return current
    return replace(current, request=replace(asked, outcome="withdrawn"))


def find(lease: Lease | None, request: str) -> tuple[Lease, ControlRequest]:
    """The lease with the request of this id: the last one is known, whatever has become of it.

    Raises:
        Problem: ``request-unknown``.
    """
    if lease is None or lease.request is None or lease.request.id != request:
        raise not_found("request", request)
    return lease, lease.request


def _to_answer(lease: Lease | None, caller: Identity, request: str) -> tuple[Lease, ControlRequest]:
    current, asked = find(lease, request)
    if not asked.addressed_to(caller):
        raise forbidden("Only who holds the lease may answer that, in the same session.")
    return current, asked


def _still(lease: Lease, asked: ControlRequest, wanted: Outcome, now_ms: int) -> bool:
    """Whether it can still be answered; not when it was answered so already."""
    how = asked.current_outcome(lease, now_ms)
    if how not in {"open", wanted}:
        raise _over(how)
    return how == "open"


_ENDS: dict[Outcome, str] = {
    "accepted": "It was accepted: whoever asked has control.",
    "rejected": "It was refused: control stays where it is.",
    "withdrawn": "Whoever asked has withdrawn it.",
    "expired": "It was not answered in time: control stays where it is. Ask again if need be.",
    "ended": "The lease that it asked for has ended. Look who has control now.",
}


def _over(how: Outcome) -> Problem:
    return Problem("control-request-closed", 409, "The request is over", _ENDS[how], extras={"outcome": how})
