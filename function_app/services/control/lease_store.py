"""Stores leases together with the events of each change."""

from collections.abc import Callable

from function_app.domain.control.lease import Lease
from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Identity
from function_app.ports.clock import Clock
from function_app.ports.monitoring import Tracing
from function_app.ports.tables import Tables
from function_app.services.control.control_events import ControlEvents, lease_change
from function_app.services.devices.control_rows import apply_device_epochs, read_control
from function_app.services.storage import records


class LeaseStore:
    """Changes leases. An action that gets its own lease writes it in its own batch."""

    def __init__(self, *, tables: Tables, control_events: ControlEvents, tracing: Tracing, clock: Clock) -> None:
        self._tables = tables
        self._control_events = control_events
        self._tracing = tracing
        self._clock = clock

    async def change(
        self, caller: Identity, device: Device, change: Callable[[Lease | None, int], Lease], *, device_epoch: int = 0
    ) -> tuple[Lease | None, Lease]:
        """Apply ``change`` (of the lease, at a time) by ETag; return the lease before and after.

        ``change`` returns the same object for no change, and may be called several times. ``device_epoch``: that of a
        rejected command. Raises ``busy``, and the problems of ``change``.
        """
        watched = False

        async def attempt() -> tuple[Lease | None, Lease]:
            nonlocal watched
            control = await read_control(self._tables, device)
            now_ms = self._clock.now_ms()
            control = apply_device_epochs(control, caller, now_ms, rejected=device_epoch)
            lease = change(control.lease, now_ms)
            if lease is control.lease:
                return lease, lease
            facts = lease_change(device.id, control.lease, lease, caller=caller, now_ms=now_ms, owner=device.owner)
            if facts and not watched:
                await self._control_events.schedule_check(device.id)
                watched = True
            await self._tables.batch(records.CONTROL, [control.write_lease(device.id, lease), *facts])
            return control.lease, lease

        with self._tracing.span("write lease"):
            before, after = await records.retry(attempt)
            if watched:
                await self._control_events.publish(device.id)
        return before, after
