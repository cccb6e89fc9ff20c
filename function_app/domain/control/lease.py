"""Lease rules: one holder, a time limit, and an epoch that only rises."""

from dataclasses import dataclass, replace
from typing import Literal

from function_app.domain.common.problems import Problem
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.identity.accounts import Identity

Outcome = Literal["open", "accepted", "rejected", "withdrawn", "expired", "ended"]
"""Of a request for control. ``ended``: the lease that it asks for has ended otherwise; look who has control now."""


@dataclass(frozen=True, slots=True)
class ControlRequest:
    """Somebody asks the holder of one epoch for control; see ``domain/handover.py``.

    Attributes:
        epoch: The lease that is asked for.
        by: Who asks, by name.
        holder_account: Who was asked,
        holder_session: and alone may answer.
        expires_ms: Until then the holder may answer: silence takes control from nobody.
        lease_ms: How long control is wanted for.
        outcome: As it was written down; ``how`` knows what time has made of it.
    """

    id: str
    epoch: int
    account: str
    session: str
    by: str
    holder_account: str
    holder_session: str
    asked_ms: int
    expires_ms: int
    lease_ms: int
    outcome: Outcome = "open"

    def current_outcome(self, lease: "Lease", now_ms: int) -> Outcome:
        """How it stands now with the request to the holder of ``lease``."""
        if self.outcome != "open":
            return self.outcome
        if now_ms >= self.expires_ms:
            return "expired"
        return "open" if lease.epoch == self.epoch and lease.is_live(now_ms) else "ended"

    def requested_by(self, caller: Identity) -> bool:
        """Whether this very sign-in session asks."""
        return self.account == caller.account and self.session == caller.session

    def addressed_to(self, caller: Identity) -> bool:
        """Whether this very sign-in session was asked."""
        return self.holder_account == caller.account and self.holder_session == caller.session


@dataclass(frozen=True, slots=True)
class Lease:
    """The right to move one device. ``account`` is empty when nobody has it: the row stays, for the epoch.

    Attributes:
        action: Id of the one action for whose time it was given, where its holder took none on purpose.
        pairing: Of the agent, when it was given. A lease of an earlier owner's pairing is nobody's.
        reason: Why it was taken from somebody else, if it was.
        asked: The last request for control, whatever has become of it.
    """

    epoch: int
    account: str = ""
    session: str = ""
    holder: str = ""
    expires_ms: int = 0
    lease_ms: int = 0
    action: str = ""
    pairing: str = ""
    reason: str = ""
    request: ControlRequest | None = None

    def is_live(self, now_ms: int) -> bool:
        """Whether somebody holds it."""
        return bool(self.account) and now_ms < self.expires_ms

    def held_by(self, caller: Identity) -> bool:
        """Whether this very sign-in session is its holder, live or not."""
        return self.account == caller.account and self.session == caller.session

    def held_by_other(self, caller: Identity, now_ms: int) -> bool:
        """Whether somebody else holds it (another sign-in session of the same account is somebody else)."""
        return self.is_live(now_ms) and not self.held_by(caller)

    def closed_request(self, now_ms: int) -> ControlRequest | None:
        """The last request, which is open no longer: what it asked for ends at this moment."""
        if self.request is None:
            return None
        how = self.request.current_outcome(self, now_ms)
        return replace(self.request, outcome="ended" if how == "open" else how)


MIN_MS = 1_000
"""The shortest lease."""


def granted_ms(lease_ms: int, left_ms: int) -> int:
    """How long a lease is given to whom the right to it is left for so long [ms]."""
    return max(MIN_MS, min(lease_ms, left_ms))


def acquire(
    lease: Lease | None,
    caller: Identity,
    *,
    lease_ms: int,
    now_ms: int,
    pairing: str = "",
    action: str = "",
    over: str = "",
) -> Lease:
    """A lease for ``caller``, always with the next epoch.

    Whoever holds it already gets a new one too: that is how control is taken again after the device has ended the
    lease by itself (a hold, a Stop, a restart), which the cloud need not know.

    Args:
        lease: As it is.
        caller: Who takes it.
        lease_ms: For how long.
        now_ms: The time.
        pairing: Of the device's agent.
        action: The one action that it is for.
        over: Why it is taken even from somebody else; empty: it is not. Only an owner may.

    Raises:
        Problem: ``lease-held`` by somebody else.
    """
    taken = lease is not None and lease.held_by_other(caller, now_ms)
    if lease is not None and taken and not over:
        raise lease_held(lease)
    return Lease(
        epoch=(lease.epoch if lease else 0) + 1,
        account=caller.account,
        session=caller.session,
        holder=caller.name,
        expires_ms=now_ms + lease_ms,
        lease_ms=lease_ms,
        action=action,
        pairing=pairing,
        reason=over if taken else "",
        request=lease.closed_request(now_ms) if lease else None,
    )


def renew(lease: Lease | None, caller: Identity, *, epoch: int, lease_ms: int, now_ms: int) -> Lease:
    """The same lease with a later end.

    Raises:
        Problem: ``lease-lost``: it ran out, or it is another's by now.
    """
    current = require_held(lease, caller, epoch=epoch, now_ms=now_ms)
    return replace(current, expires_ms=now_ms + lease_ms, lease_ms=lease_ms, action="")


def require_held(lease: Lease | None, caller: Identity, *, epoch: int, now_ms: int) -> Lease:
    """The lease, once it is seen that ``caller`` holds this epoch of it now.

    Raises:
        Problem: ``lease-lost``.
    """
    if lease is None or lease.epoch != epoch or not lease.held_by(caller) or not lease.is_live(now_ms):
        extras = {"epoch": epoch, "current_epoch": lease.epoch if lease else 0}
        detail = f"Epoch {epoch} of the lease is not yours any more. Take the lease again."
        raise Problem("lease-lost", 409, "The lease is lost", detail, extras=extras)
    return lease


def release(lease: Lease, *, now_ms: int) -> Lease:
    """Nobody's lease; the epoch stays, so that the next one is higher."""
    return Lease(epoch=lease.epoch, pairing=lease.pairing, request=lease.closed_request(now_ms))


def invalidate(lease: Lease | None, *, pairing: str, now_ms: int) -> Lease:
    """Nobody's lease with the next epoch: all that was ordered under the one before is old."""
    if lease is None:
        return Lease(epoch=1, pairing=pairing)
    return Lease(epoch=lease.epoch + 1, pairing=pairing, request=lease.closed_request(now_ms))


def lease_held(lease: Lease) -> Problem:
    """The refusal that names the holder."""
    ends = rfc3339(lease.expires_ms)
    detail = f"{lease.holder} controls this device until {ends}. Ask for control at lease/requests, or wait."
    extras = {"holder": lease.holder, "expires_at": ends, "mine": False}
    return Problem("lease-held", 409, "Somebody else controls the device", detail, extras=extras)
