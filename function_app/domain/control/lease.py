"""Lease rules: one holder, an expiry time, and an epoch that only increases."""

from dataclasses import dataclass, replace
from typing import Literal

from function_app.domain.common.problems import Problem
from function_app.domain.common.timestamps import CLOCK_SKEW_MS, rfc3339
from function_app.domain.identity.accounts import Identity

Outcome = Literal["open", "accepted", "rejected", "withdrawn", "expired", "ended"]
"""Outcome of a control request. ``ended``: the requested lease ended in another way."""


@dataclass(frozen=True, slots=True)
class ControlRequest:
    """A request to the holder of one epoch for control; see ``control_request``.

    Attributes:
        epoch: Epoch of the requested lease.
        by: Name of the requester.
        holder_account: Account of the holder at the time of the request.
        holder_session: Session of that holder; only this session may answer.
        expires_ms: End of the time to answer. A timeout does not transfer control.
        lease_ms: Duration of the requested lease.
        outcome: Stored outcome; ``current_outcome`` also considers timeouts.
    """

    id: str
    epoch: int
    account: str
    session: str
    by: str
    holder_account: str
    holder_session: str
    requested_ms: int
    expires_ms: int
    lease_ms: int
    outcome: Outcome = "open"

    def current_outcome(self, lease: "Lease", now_ms: int) -> Outcome:
        """The outcome now, given the current lease."""
        if self.outcome != "open":
            return self.outcome
        if now_ms >= self.expires_ms:
            return "expired"
        return "open" if lease.epoch == self.epoch and lease.is_live(now_ms) else "ended"

    def requested_by(self, caller: Identity) -> bool:
        """Whether this sign-in session made the request."""
        return self.account == caller.account and self.session == caller.session

    def addressed_to(self, caller: Identity) -> bool:
        """Whether the request is addressed to this sign-in session."""
        return self.holder_account == caller.account and self.holder_session == caller.session


@dataclass(frozen=True, slots=True)
class Lease:
    """The right to move one device. ``account`` is empty if the lease is free; the row remains because of the epoch.

    Attributes:
        action: Id of the action for which the lease was created automatically.
        pairing: Pairing of the agent. A lease of an earlier pairing is ignored.
        reason: Why it was taken over from another holder.
        request: The last request for control, open or closed.
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
        """Whether a session holds the lease. An end that is too far ahead is from before the clock was set back."""
        return bool(self.account) and 0 < self.expires_ms - now_ms <= self.lease_ms + CLOCK_SKEW_MS

    def held_by(self, caller: Identity) -> bool:
        """Whether this sign-in session is the holder, also after expiry."""
        return self.account == caller.account and self.session == caller.session

    def held_by_other(self, caller: Identity, now_ms: int) -> bool:
        """Whether another session holds the lease; sessions of the same account count as different."""
        return self.is_live(now_ms) and not self.held_by(caller)

    def closed_request(self, now_ms: int) -> ControlRequest | None:
        """The last request, which ends with this lease."""
        if self.request is None:
            return None
        outcome = self.request.current_outcome(self, now_ms)
        return replace(self.request, outcome="ended" if outcome == "open" else outcome)


MIN_MS = 1_000
"""Shortest lease [ms]."""
RESTORE_JUMP = 2**20
"""More grants than a device gets between a backup and its restore: one per second for twelve days."""
MAX_EPOCH_JUMP = 2**24
"""Highest increase of an epoch to that of a device, because its reports are not signed.

A forged report cannot exhaust the epochs (2⁵³): that takes 2²⁹ grants, each after another forged report.
"""


def granted_ms(lease_ms: int, left_ms: int) -> int:
    """Duration of a lease for a caller whose permission ends in ``left_ms`` [ms]."""
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
    """A lease for ``caller`` with the next epoch. Raises ``lease-held``: another session is the holder.

    The current holder also gets a new epoch, because the device may have ended the lease (hold, Stop, restart) without
    knowledge of the cloud. ``action`` is the only action that the lease is for; ``over`` is the reason for a takeover,
    which only owners may request.
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
    """The same lease with a later expiry time. Raises ``lease-lost``: it expired or has another holder."""
    current = require_held(lease, caller, epoch=epoch, now_ms=now_ms)
    return replace(current, expires_ms=now_ms + lease_ms, lease_ms=lease_ms, action="")


def require_held(lease: Lease | None, caller: Identity, *, epoch: int, now_ms: int) -> Lease:
    """The lease, if ``caller`` holds this epoch now. Raises ``lease-lost``."""
    if lease is None or lease.epoch != epoch or not lease.held_by(caller) or not lease.is_live(now_ms):
        extras = {"epoch": epoch, "current_epoch": lease.epoch if lease else 0}
        detail = f"This session no longer holds epoch {epoch} of the lease. Acquire the lease again."
        raise Problem("lease-lost", 409, "The lease is lost", detail, extras=extras)
    return lease


def release(lease: Lease, *, now_ms: int) -> Lease:
    """A free lease with the same epoch, so that the next epoch is higher."""
    return Lease(epoch=lease.epoch, pairing=lease.pairing, request=lease.closed_request(now_ms))


def catch_up(lease: Lease | None, device_epoch: int, *, now_ms: int) -> Lease | None:
    """The lease after the device has reported ``device_epoch``; unchanged if that is not higher.

    Only a restored backup of the tables is behind the device. Its lease is not in force there, so it is free. Its epoch
    is that of the device, at most ``MAX_EPOCH_JUMP`` higher, so that the next grant is accepted.
    """
    epoch = lease.epoch if lease is not None else 0
    if device_epoch <= epoch:
        return lease
    caught_up = min(device_epoch, epoch + MAX_EPOCH_JUMP)
    return replace(Lease(epoch=epoch) if lease is None else release(lease, now_ms=now_ms), epoch=caught_up)


def invalidate(lease: Lease | None, *, pairing: str, now_ms: int) -> Lease:
    """A free lease with the next epoch, which fences all earlier commands."""
    if lease is None:
        return Lease(epoch=1, pairing=pairing)
    return Lease(epoch=lease.epoch + 1, pairing=pairing, request=lease.closed_request(now_ms))


def after_restore(lease: Lease | None, *, pairing: str, now_ms: int) -> Lease:
    """A free lease with an epoch above all that were granted after the backup, also those still on their way.

    Otherwise two operators could hold the same epoch: one from before the restore, one from after it.
    """
    free = invalidate(lease, pairing=pairing, now_ms=now_ms)
    return replace(free, epoch=free.epoch + RESTORE_JUMP)


def lease_held(lease: Lease) -> Problem:
    """The rejection that names the holder."""
    ends = rfc3339(lease.expires_ms)
    detail = f"{lease.holder} controls this device until {ends}. Request control at lease/requests, or wait."
    extras = {"holder": lease.holder, "expires_at": ends, "mine": False}
    return Problem("lease-held", 409, "Another session controls the device", detail, extras=extras)
