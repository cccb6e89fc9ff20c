"""Control authority of one device: leases, Stop, faults, restrictions and the reservation of an action.

This module does not move the device. When the right to move ends, it calls ``hold``, which brings the device to rest.
"""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from msgspec.structs import replace

from device_agent.protocol import StopLatch
from device_agent.protocol.events import EventKind
from device_agent.protocol.security.setpoints import SetpointKeys
from device_agent.runtime.authority.event_recorder import EventRecord, RecordEvent, Severity
from device_agent.runtime.authority.lease_gate import Lease, LeaseGate
from device_agent.runtime.authority.speed_restrictions import Restrictions
from device_agent.runtime.errors import Refused


@dataclass(eq=False)
class Reservation:
    """An action's exclusive use of the device, until the action ends or ``why`` states why it was revoked.

    ``on_revoked`` is called once with the controller locked: it must be quick and must not call the controller.
    """

    epoch: int
    on_revoked: Callable[[Refused], None]
    why: Refused | None = None


class Authority:
    """The right to move one device. Not thread-safe: the controller locks.

    ``hold`` is called when the current source of motion loses the right to move. ``record`` receives an event
    for each change of authority; it must not block or call the controller.

    Attributes:
        changed: Set when epochs or latch changed and must be journalled; the command processor clears it.
        latch: The Stop latch.
        fault: Error message of the driver.
        device_stopped: Whether ``fault`` is a stop of the device itself, which prevents the reset of Stop.
        reservation: Reservation of the running action.
        restrictions: Speed restrictions of the room.
        suspended: Why nothing may move and no lease is granted until it is empty again; see ``Device.suspend``.
    """

    def __init__(
        self, gate: LeaseGate, latch: StopLatch | None, *, hold: Callable[[Refused], None], record: RecordEvent
    ) -> None:
        self._gate = gate
        self._hold = hold
        self._record = record
        self.changed = threading.Event()
        self.latch = latch
        self.fault: str | None = None
        self.device_stopped = False
        self.reservation: Reservation | None = None
        self.restrictions = Restrictions()
        self.suspended = ""

    @property
    def epochs(self) -> tuple[int, int]:
        """Highest epoch seen, highest epoch burned."""
        return self._gate.epoch, self._gate.burned

    @property
    def ended_input(self) -> int:
        """Highest input of the newest epoch that the device no longer accepts."""
        return self._gate.ended_input

    @property
    def ended(self) -> bool:
        """Whether the newest epoch is burned, or its newest input has ended."""
        gate = self._gate
        return gate.burned >= gate.epoch or 0 < gate.input == gate.ended_input

    def lease(self, now_s: float) -> Lease | None:
        """The lease in force."""
        return self._gate.current(now_s)

    def grant(
        self, *, epoch: int, holder: str, lease_s: float, now_s: float, reason: str = "", keys: SetpointKeys = ()
    ) -> bool:
        """See ``Controller.grant``. Returns True if the epoch is new and the previous holder lost control."""
        self._check_not_suspended()
        before, previous = self._gate.epoch, self._gate.granted
        self._gate.grant(epoch=epoch, holder=holder, lease_s=lease_s, now_s=now_s, reason=reason, keys=keys)
        new = self._superseded(before, previous, f"{holder} took control")
        if previous is None or previous.epoch != epoch:
            self.record(EventKind.LEASE_GRANTED, f"{holder} took control", {"epoch": epoch, "holder": holder})
        return new

    def release(self, epoch: int) -> None:
        """See ``Controller.release``."""
        self._gate.fence(epoch)
        self.end(Refused("lease_lost", "control was released"))

    def fence(self, epoch: int) -> bool:
        """Check the epoch of a signed command. Returns True if it is new and the previous holder lost control."""
        before, previous = self._gate.epoch, self._gate.granted
        self._gate.fence(epoch)
        if epoch == before and epoch <= self._gate.burned:
            raise Refused("lease_ended", f"lease {epoch} has ended at the device; take control again")
        return self._superseded(before, previous, "a newer lease took the device")

    def expire(self, now_s: float) -> None:
        """End an expired lease."""
        previous = self._gate.granted
        if self._gate.expire(now_s):
            self.end(Refused("lease_lost", "the lease expired"), previous)

    def stop(self, latch: StopLatch, *, message: str = "") -> None:
        """Latch Stop. The first latch remains the one shown, but a verified caller replaces an unverified one.

        Args:
            latch: The latch.
            message: Id of the Stop message or command, for the event.
        """
        data = {"stop": message, "caller": latch.caller, "reason": latch.reason, "verified": latch.verified}
        if self.latch is None:
            self.latch = latch
            self.record(EventKind.STOP_LATCHED, f"stopped by {latch.caller}", data, "warning")
        elif latch.verified and not self.latch.verified:
            self.latch = replace(latch, at_ms=self.latch.at_ms)
            self.record(EventKind.STOP_VERIFIED, f"{latch.caller} sent a signed Stop", data)
        self.end(Refused("stopped", f"stopped by {self.latch.caller}"))

    def reset_stop(self) -> None:
        """Release the latch. Every lease so far ends.

        Raises:
            Refused: The device has stopped itself; the latch remains.
        """
        self.end(Refused("lease_lost", "Stop was reset; take control again"))
        if self.device_stopped:
            raise Refused("device_stopped", f"the device has stopped itself: {self.fault}")
        self.latch = None

    def set_fault(self, message: str) -> None:
        """Record that the driver failed, and hold."""
        self.fault, self.device_stopped = message, False
        self.end(Refused("fault", message))

    def follow_device_stop(self, latch: StopLatch) -> None:
        """Record that the device has stopped itself, hold, and latch Stop.

        Another reason of the same stop ends nothing: a recovery that changes the reason continues.
        """
        stopped, self.device_stopped, self.fault = self.device_stopped, True, latch.reason
        if not stopped:
            self.end(Refused("fault", latch.reason))
        if self.latch is None:
            self.stop(latch)

    def clear_fault(self) -> bool:
        """Record that the driver works again. Returns False if it had not failed."""
        failed = self.fault is not None
        self.fault, self.device_stopped = None, False
        return failed

    def end(self, why: Refused, lease: Lease | None = None) -> None:
        """Burn the epoch in force: control must be taken again. ``lease``: the one that the gate has just ended."""
        self.changed.set()
        self._record_end(lease or self._gate.granted, why)
        self._gate.burn()
        self.revoke(why)

    def check_input(self, number: int) -> None:
        """See ``LeaseGate.check_input``."""
        self._gate.check_input(number)

    def end_input(self, why: Refused) -> None:
        """Hold until the operator starts a new input. Setpoints without an input number lose their lease."""
        if self._gate.end_input():
            self._hold(why)
        else:
            self.end(why)

    def reserve(self, epoch: int, on_revoked: Callable[[Refused], None]) -> Reservation:
        """Reserve the device for an action.

        Raises:
            Refused: Another action has reserved it.
        """
        if self.reservation is not None:
            raise Refused("busy", "another action runs on this device")
        self.reservation = Reservation(epoch, on_revoked)
        return self.reservation

    def check_free(self) -> None:
        """Check that nothing prevents motion.

        Raises:
            Refused: Suspended, stopped, faulty, or held by the room.
        """
        self._check_not_suspended()
        if self.latch is not None:
            raise Refused("stopped", f"stopped by {self.latch.caller}; reset Stop first")
        if self.fault is not None:
            raise Refused("fault", self.fault)
        strictest = self.restrictions.strictest
        if strictest is not None and strictest.speed <= 0:
            raise Refused("interlock", f"the room holds the device: {strictest.why}")

    def _check_not_suspended(self) -> None:
        if self.suspended:
            raise Refused("restarting", self.suspended)

    def check_goal(self, reservation: Reservation) -> None:
        """Check that nothing prevents motion, and that this reservation is in force. Raises ``Refused``."""
        self.check_free()
        self.check_reservation(reservation)

    def check_reservation(self, reservation: Reservation) -> None:
        """Check that this reservation is in force.

        Raises:
            Refused: It is not; the reason states why it was revoked.
        """
        if self.reservation is not reservation:
            raise reservation.why or Refused("ended", "the action ended")

    def revoke(self, why: Refused) -> None:
        """Hold, and revoke the reservation of the running action."""
        revoked, self.reservation = self.reservation, None
        self._hold(why)
        if revoked is not None:
            self.record(EventKind.ACTION_LOST, why.message, self.event_data(why), "warning")
            revoked.why = why
            revoked.on_revoked(why)

    def event_data(self, why: Refused) -> dict[str, object]:
        """Event data of a reason."""
        return {"code": why.code, "epoch": self._gate.epoch}

    def record(self, kind: EventKind, message: str, data: Mapping[str, object], severity: Severity = "info") -> None:
        """Record an event."""
        self._record(EventRecord(kind, message, severity, data))

    def _superseded(self, before: int, previous: Lease | None, message: str) -> bool:
        if self._gate.epoch == before:
            return False
        self.changed.set()
        why = Refused("lease_lost", message)
        self._record_end(previous, why)
        self.revoke(why)
        return True

    def _record_end(self, lease: Lease | None, why: Refused) -> None:
        if lease is not None:
            data = {"epoch": lease.epoch, "holder": lease.holder, "code": why.code}
            self.record(EventKind.LEASE_ENDED, f"{lease.holder}'s control ended: {why.message}", data)
