"""Lease gate: accepts or rejects lease epochs on the agent's own clock."""

from dataclasses import dataclass, field

from device_agent.protocol.security.setpoints import SetpointKeys
from device_agent.runtime.errors import Refused


@dataclass(frozen=True, slots=True)
class Lease:
    """Right to move the device until ``expires_s`` on the agent's monotonic clock [s].

    ``reason`` states why control was taken from the previous holder. ``keys`` authenticate the setpoints of this epoch;
    without a key, none is accepted.
    """

    holder: str
    epoch: int
    expires_s: float
    reason: str = ""
    keys: SetpointKeys = field(default=(), repr=False)


class LeaseGate:
    """Epochs of one device. Not thread-safe: the controller locks.

    ``epoch`` is the highest epoch seen. ``burned`` is the highest epoch that the device no longer accepts. An epoch is
    burned when its lease ends. ``input`` is the newest input of this epoch, and ``ended_input`` the highest one that
    the device no longer accepts. After a watchdog hold, motion resumes only with a higher input.
    """

    def __init__(self, *, epoch: int = 0, burned: int = 0) -> None:
        self.epoch = epoch
        self.burned = max(burned, 0)
        self.input = self.ended_input = 0
        self._lease: Lease | None = None

    def grant(
        self, *, epoch: int, holder: str, lease_s: float, now_s: float, reason: str = "", keys: SetpointKeys = ()
    ) -> None:
        """Accept a signed grant or renewal.

        Raises:
            Refused: The epoch is older than the newest one, or burned.
        """
        self.fence(epoch)
        if epoch <= self.burned:
            raise Refused("lease_ended", f"lease {epoch} has ended at the device; take control again")
        self.epoch = epoch
        if self._lease is not None:  # a renewal keeps the reason of the grant
            reason = reason or self._lease.reason
        self._lease = Lease(holder, epoch, now_s + lease_s, reason, keys)

    def fence(self, epoch: int) -> None:
        """Reject an older epoch. A newer epoch ends the lease in force.

        Raises:
            Refused: ``epoch`` is lower than the highest one seen.
        """
        if epoch < self.epoch:
            raise Refused("stale_epoch", f"from lease {epoch}, but lease {self.epoch} is in force")
        if epoch > self.epoch:
            self.epoch = epoch
            self.input = self.ended_input = 0
            self._lease = None

    def check_input(self, number: int) -> None:
        """Accept the newest input, or a higher one, which ends all lower ones.

        Raises:
            Refused: The input has ended. In a lease with numbered inputs, this includes 0.
        """
        if self.input and number <= self.ended_input:
            raise Refused("input_ended", f"input {number} has ended; release the control and start a new input")
        if number > self.input:
            self.input, self.ended_input = number, number - 1

    def end_input(self) -> bool:
        """End the newest input. Returns False if this lease has no numbered input."""
        self.ended_input = self.input
        return self.input > 0

    def current(self, now_s: float) -> Lease | None:
        """The lease in force, if any."""
        return self._lease if self._lease is not None and now_s < self._lease.expires_s else None

    @property
    def granted(self) -> Lease | None:
        """The last granted lease that has not ended, even if it has just expired."""
        return self._lease

    def expire(self, now_s: float) -> bool:
        """Burn an expired lease. Returns True if there was one."""
        if self._lease is None or now_s < self._lease.expires_s:
            return False
        self.burn()
        return True

    def burn(self) -> None:
        """End the lease in force. The device never accepts its epoch again."""
        self.burned = max(self.burned, self.epoch)
        self._lease = None
