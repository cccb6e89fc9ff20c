"""Who may move the device: the lease gate. Checked here, where the motors are, on the agent's own clock."""

from dataclasses import dataclass

from device_agent.runtime.errors import Refused


@dataclass(frozen=True, slots=True)
class Lease:
    """The right to move the device until ``expires_s`` on the agent's monotonic clock [s].

    ``reason``: why it was taken from somebody else.
    """

    holder: str
    epoch: int
    expires_s: float
    reason: str = ""


class LeaseGate:
    """The epochs of one device. Not thread-safe: its owner locks.

    ``epoch`` is the highest ever seen. ``burned`` is the highest that is no longer obeyed, whatever arrives: epochs
    are burned when the lease ends, and when motion had to be held because the operator's word stopped coming. Nothing
    resumes by itself: control must be taken again, which gives a new epoch.

    Args:
        epoch: Highest epoch seen before a restart.
        burned: Highest epoch burned before a restart.
    """

    def __init__(self, *, epoch: int = 0, burned: int = 0) -> None:
        self.epoch = epoch
        self.burned = max(burned, 0)
        self._lease: Lease | None = None

    def grant(self, *, epoch: int, holder: str, lease_s: float, now_s: float, reason: str = "") -> None:
        """Take in a signed grant or renewal.

        Raises:
            Refused: An older epoch than one seen already, or one that was burned.
        """
        self.fence(epoch)
        if epoch <= self.burned:
            raise Refused("lease_ended", f"lease {epoch} has ended at the device; take control again")
        self.epoch = epoch
        if self._lease is not None:  # a renewal: what was said at the beginning still holds
            reason = reason or self._lease.reason
        self._lease = Lease(holder, epoch, now_s + lease_s, reason)

    def fence(self, epoch: int) -> None:
        """Refuse what comes from an older lease; adopt a newer epoch, which ends the lease in force.

        Raises:
            Refused: ``epoch`` is lower than the highest seen.
        """
        if epoch < self.epoch:
            raise Refused("stale_epoch", f"from lease {epoch}, but lease {self.epoch} is in force")
        if epoch > self.epoch:
            self.epoch = epoch
            self._lease = None

    def current(self, now_s: float) -> Lease | None:
        """The lease in force, if any."""
        return self._lease if self._lease is not None and now_s < self._lease.expires_s else None

    @property
    def granted(self) -> Lease | None:
        """The lease that was granted last and not ended since, also when it has just run out."""
        return self._lease

    def expire(self, now_s: float) -> bool:
        """Burn a lease that has run out; True when there was one."""
        if self._lease is None or now_s < self._lease.expires_s:
            return False
        self.burn()
        return True

    def burn(self) -> None:
        """End the lease in force: its epoch is not obeyed again."""
        self.burned = max(self.burned, self.epoch)
        self._lease = None
