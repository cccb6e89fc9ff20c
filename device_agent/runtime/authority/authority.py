"""Who may move one device now, and what forbids it: leases, Stop, faults, restrictions, the action that has it.

Nothing here moves anything. Whenever the right to move ends, ``hold`` is called: it brings the device to rest.
"""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from device_agent.protocol import StopLatch
from device_agent.protocol.events import EventKind
from device_agent.runtime.authority.event_recorder import EventRecord, Severity, Tell
from device_agent.runtime.authority.lease_gate import Lease, LeaseGate
from device_agent.runtime.authority.speed_restrictions import Restrictions
from device_agent.runtime.errors import Refused


@dataclass(eq=False)
class Reservation:
    """An action's hold on the device, from ``begin_action`` until the action ends or ``why`` says who took it away.

    ``on_lost`` is called once, with the controller locked: it must be quick and must not call back.
    """

    epoch: int
    on_lost: Callable[[Refused], None]
    why: Refused | None = None


class Authority:
    """The right to move one device. Not thread-safe: its owner locks.

    Args:
        gate: The lease gate, with the epochs remembered from before.
        latch: The Stop latch remembered from before.
        hold: Called when whoever moved the device no longer may.
        tell: Called with each change of authority: quick, and does not call back.

    Attributes:
        changed: Set whenever epochs or the latch have changed and must be written down; whoever does clears it.
        latch: The Stop latch.
        fault: What is wrong with the driver.
        tenure: The action that has the device.
        restrictions: What the room allows.
    """

    def __init__(
        self, gate: LeaseGate, latch: StopLatch | None, *, hold: Callable[[Refused], None], tell: Tell
    ) -> None:
        self._gate = gate
        self._hold = hold
        self._tell = tell
        self.changed = threading.Event()
        self.latch = latch
        self.fault: str | None = None
        self.tenure: Reservation | None = None
        self.restrictions = Restrictions()

    @property
    def epochs(self) -> tuple[int, int]:
        """Highest epoch seen, highest epoch burned."""
        return self._gate.epoch, self._gate.burned

    @property
    def burned(self) -> bool:
        """Whether the newest epoch is obeyed no more."""
        return self._gate.burned >= self._gate.epoch

    def lease(self, now_s: float) -> Lease | None:
        """The lease in force."""
        return self._gate.current(now_s)

    def grant(self, *, epoch: int, holder: str, lease_s: float, now_s: float, reason: str = "") -> bool:
        """Take in a grant or renewal; True when the epoch is new and whoever had the device before has lost it.

        Raises:
            Refused: Stale or ended.
        """
        before, had = self._gate.epoch, self._gate.granted
        self._gate.grant(epoch=epoch, holder=holder, lease_s=lease_s, now_s=now_s, reason=reason)
        new = self._superseded(before, had)
        if had is None or had.epoch != epoch:
            self.note(EventKind.LEASE_GRANTED, f"{holder} took control", {"epoch": epoch, "holder": holder})
        return new

    def release(self, epoch: int) -> None:
        """The holder gave the lease up.

        Raises:
            Refused: From an older lease.
        """
        self._gate.fence(epoch)
        self.end(Refused("lease_lost", "control was released"))

    def fence(self, epoch: int) -> bool:
        """Check the epoch of a signed command; True when it is new and takes the device from whoever had it.

        Raises:
            Refused: Stale, or of a lease that has ended here.
        """
        before, had = self._gate.epoch, self._gate.granted
        self._gate.fence(epoch)
        if epoch == before and epoch <= self._gate.burned:
            raise Refused("lease_ended", f"lease {epoch} has ended at the device; take control again")
        return self._superseded(before, had)

    def expire(self, now_s: float) -> None:
        """End a lease that has run out."""
        had = self._gate.granted
        if self._gate.expire(now_s):
            self.end(Refused("lease_lost", "the lease ran out"), had)

    def stop(self, latch: StopLatch) -> None:
        """Latch Stop. The first latch stays the one shown."""
        if self.latch is None:
            self.latch = latch
            data = {"caller": latch.caller, "reason": latch.reason}
            self.note(EventKind.STOP_LATCHED, f"stopped by {latch.caller}", data, "warning")
        self.end(Refused("stopped", "the device was stopped"))

    def reset_stop(self) -> None:
        """Release the latch; every lease so far ends with it."""
        self.end(Refused("lease_lost", "Stop was reset; take control again"))
        self.latch = None

    def fail(self, message: str) -> None:
        """The driver no longer answers."""
        if self.fault != message:
            self.note(EventKind.DRIVER_FAILED, message, {}, "error")
        self.fault = message
        self.end(Refused("fault", message))

    def recover(self) -> bool:
        """The driver answers again; False when it had not failed."""
        failed, self.fault = self.fault is not None, None
        if failed:
            self.note(EventKind.DRIVER_RECOVERED, "the device answers again", {})
        return failed

    def end(self, why: Refused, had: Lease | None = None) -> None:
        """Burn the epoch in force: control must be taken again.

        Args:
            why: Why.
            had: The lease that ends, where it is no longer known to the gate.
        """
        self.changed.set()
        self._note_end(had or self._gate.granted, why)
        self._gate.burn()
        self.lose(why)

    def begin(self, epoch: int, on_lost: Callable[[Refused], None]) -> Reservation:
        """An action now has the device.

        Raises:
            Refused: Another has it.
        """
        if self.tenure is not None:
            raise Refused("busy", "another action runs on this device")
        self.tenure = Reservation(epoch, on_lost)
        return self.tenure

    def check_free(self) -> None:
        """Nothing forbids that the device moves.

        Raises:
            Refused: Stopped, faulty, or the room holds it.
        """
        if self.latch is not None:
            raise Refused("stopped", f"stopped by {self.latch.caller}; reset Stop first")
        if self.fault is not None:
            raise Refused("fault", self.fault)
        strictest = self.restrictions.strictest
        if strictest is not None and strictest.speed <= 0:
            raise Refused("interlock", f"the room holds the device: {strictest.why}")

    def check_tenure(self, tenure: Reservation) -> None:
        """This action still has the device.

        Raises:
            Refused: It does not; the reason says who took it away.
        """
        if self.tenure is not tenure:
            raise tenure.why or Refused("ended", "the action ended")

    def lose(self, why: Refused) -> None:
        """Whoever moved the device, by setpoints or as an action, no longer does."""
        lost, self.tenure = self.tenure, None
        self._hold(why)
        if lost is not None:
            self.note(EventKind.ACTION_LOST, why.message, self.said(why), "warning")
            lost.why = why
            lost.on_lost(why)

    def said(self, why: Refused) -> dict[str, object]:
        """A reason, as events carry it."""
        return {"code": why.code, "epoch": self._gate.epoch}

    def note(self, kind: EventKind, message: str, data: Mapping[str, object], severity: Severity = "info") -> None:
        """Tell what happened."""
        self._tell(EventRecord(kind, message, severity, data))

    def _superseded(self, before: int, had: Lease | None) -> bool:
        if self._gate.epoch == before:
            return False
        self.changed.set()
        why = Refused("lease_lost", "a newer lease took the device")
        self._note_end(had, why)
        self.lose(why)
        return True

    def _note_end(self, had: Lease | None, why: Refused) -> None:
        if had is not None:
            data = {"epoch": had.epoch, "holder": had.holder, "code": why.code}
            self.note(EventKind.LEASE_ENDED, f"{had.holder}'s control ended: {why.message}", data)
