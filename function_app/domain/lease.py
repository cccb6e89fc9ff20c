"""Lease rules: one holder, a time limit, and an epoch that only rises."""

from dataclasses import dataclass, replace

from function_app.domain.accounts import Identity
from function_app.domain.problems import Problem
from function_app.domain.times import rfc3339


@dataclass(frozen=True, slots=True)
class Lease:
    """The right to move one device. ``account`` is empty when nobody has it: the row stays, for the epoch.

    Attributes:
        action: Id of the one action for whose time it was given, where its holder took none on purpose.
        pairing: Of the agent, when it was given. A lease of an earlier owner's pairing is nobody's.
    """

    epoch: int
    account: str = ""
    session: str = ""
    holder: str = ""
    expires_ms: int = 0
    lease_ms: int = 0
    action: str = ""
    pairing: str = ""

    def live(self, now_ms: int) -> bool:
        """Whether somebody holds it."""
        return bool(self.account) and now_ms < self.expires_ms

    def mine(self, who: Identity) -> bool:
        """Whether this very sign-in session is its holder, live or not."""
        return self.account == who.account and self.session == who.session


def take(
    lease: Lease | None, who: Identity, *, lease_ms: int, now_ms: int, pairing: str = "", action: str = ""
) -> Lease:
    """A lease for ``who``, always with the next epoch.

    Whoever holds it already gets a new one too: that is how control is taken again after the device has ended the
    lease by itself (a hold, a Stop, a restart), which the cloud need not know.

    Raises:
        Problem: ``lease-held`` by somebody else (another sign-in session of the same account is somebody else).
    """
    if lease is not None and lease.live(now_ms) and not lease.mine(who):
        raise held(lease)
    return Lease(
        epoch=(lease.epoch if lease else 0) + 1,
        account=who.account,
        session=who.session,
        holder=who.name,
        expires_ms=now_ms + lease_ms,
        lease_ms=lease_ms,
        action=action,
        pairing=pairing,
    )


def renew(lease: Lease | None, who: Identity, *, epoch: int, lease_ms: int, now_ms: int) -> Lease:
    """The same lease with a later end.

    Raises:
        Problem: ``lease-lost``: it ran out, or it is another's by now.
    """
    current = hold(lease, who, epoch=epoch, now_ms=now_ms)
    return replace(current, expires_ms=now_ms + lease_ms, lease_ms=lease_ms, action="")


def hold(lease: Lease | None, who: Identity, *, epoch: int, now_ms: int) -> Lease:
    """The lease, once it is seen that ``who`` holds this epoch of it now.

    Raises:
        Problem: ``lease-lost``.
    """
    if lease is None or lease.epoch != epoch or not lease.mine(who) or not lease.live(now_ms):
        extras = {"epoch": epoch, "current_epoch": lease.epoch if lease else 0}
        detail = f"Epoch {epoch} of the lease is not yours any more. Take the lease again."
        raise Problem("lease-lost", 409, "The lease is lost", detail, extras=extras)
    return lease


def release(lease: Lease) -> Lease:
    """Nobody's lease; the epoch stays, so that the next one is higher."""
    return Lease(epoch=lease.epoch)


def overtake(lease: Lease | None, *, pairing: str) -> Lease:
    """Nobody's lease with the next epoch: all that was ordered under the one before is old."""
    return Lease(epoch=(lease.epoch if lease else 0) + 1, pairing=pairing)


def held(lease: Lease) -> Problem:
    """The refusal that names the holder."""
    ends = rfc3339(lease.expires_ms)
    detail = f"{lease.holder} controls this device until {ends}. Ask for it, or wait."
    extras = {"holder": lease.holder, "expires_at": ends, "mine": False}
    return Problem("lease-held", 409, "Somebody else controls the device", detail, extras=extras)
