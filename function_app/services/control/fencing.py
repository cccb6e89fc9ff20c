"""Revokes control: increases the epoch, closes the setpoint connection and holds the device."""

import asyncio
import logging

from device_agent.protocol import ReleaseLease
from function_app.domain.control.control_events import control_ended
from function_app.domain.control.lease import Lease, catch_up
from function_app.domain.devices.devices import Device
from function_app.ports.broker_access import BrokerAccess, BrokerAccessError
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.control.control_events import event_writes
from function_app.services.devices.control_rows import read_control_rows
from function_app.services.identity.authenticator import everything
from function_app.services.messaging.command_sender import CommandSender
from function_app.services.storage import records

_log = logging.getLogger(__name__)


class ControlRevocation:
    """Revokes leases when the permission of the holder has ended."""

    def __init__(self, *, tables: Tables, command_sender: CommandSender, access: BrokerAccess, clock: Clock) -> None:
        self._tables = tables
        self._command_sender = command_sender
        self._access = access
        self._clock = clock

    async def revoke(
        self, device: Device, why: str, *, account: str | None = None, until_s: float | None = None
    ) -> bool:
        """Increase the epoch, so that setpoints and commands of the holder are fenced, and hold the device.

        An expired lease is fenced too: its commands may still be in transit.

        Args:
            device: The device, with the pairing of the lease.
            why: Reason.
            account: Only if this account holds it; ``None``: any holder.
            until_s: Deadline for notifying broker and device, by the loop's clock [s]; ``None``: no deadline.

        Returns:
            Whether broker and device were notified. The lease has ended in any case.
        """

        async def attempt() -> tuple[Lease, int] | None:
            control = await read_control_rows(self._tables, device.id)
            existing = control.lease
            if existing is None or not existing.account or existing.pairing != device.pairing:
                return None
            if account not in {None, existing.account}:
                return None
            now_ms = self._clock.now_ms()
            newest = catch_up(existing, control.reported.seen, now_ms=now_ms) or existing
            lease = Lease(epoch=newest.epoch + 1, pairing=device.pairing)
            fact = control_ended(existing, lease, why=why, now_ms=now_ms)
            facts = event_writes(device.id, device.pairing, [fact], owner=device.owner)
            await self._tables.batch(records.CONTROL, [control.write_lease(device.id, lease), *facts])
            return lease, existing.epoch

        revoked = await records.retry(attempt)
        return revoked is None or await self._notify(device, *revoked, until_s)

    async def retry(self, device: Device, account: str, *, until_s: float) -> bool:
        """Notify broker and device again about the end of an account's lease; return whether it succeeded.

        If another account has control, the device gets its lease. The former epochs are no longer stored, so all
        connections of the account are closed.
        """
        control = await read_control_rows(self._tables, device.id)
        lease = control.lease
        if lease is None or lease.pairing != device.pairing:
            return True
        if not lease.account:
            return await self._notify(device, lease, lease.epoch - 1, until_s)
        try:
            async with asyncio.timeout_at(until_s):
                await self._access.revoke(principal=everything(account))
        except (BrokerAccessError, TimeoutError) as error:
            _log.warning("sessions of %s: %s", account, str(error) or "the broker did not answer in time")
            return False
        return True

    async def _notify(self, device: Device, lease: Lease, previous: int, until_s: float | None) -> bool:
        """Cut the setpoint connection of the epoch ``previous`` and notify the device, concurrently."""
        try:
            async with asyncio.timeout_at(until_s):
                release = self._command_sender.try_send(device, ReleaseLease(), caller="telescope", epoch=lease.epoch)
                return all(await asyncio.gather(self.cut(device, previous), release))
        except TimeoutError:
            _log.warning("end of control of %s: the broker did not answer in time", device.id)
            return False

    async def cut(self, device: Device, epoch: int) -> bool:
        """Revoke the broker credentials for the setpoints of an epoch, best effort: fencing without the device."""
        try:
            await self._access.revoke(client_id=control_client(device.id, epoch))
        except BrokerAccessError as error:
            _log.warning("setpoints of lease %d of %s: %s", epoch, device.id, error)
            return False
        return True


def control_client(device: str, epoch: int) -> str:
    """MQTT client id of the connection for the setpoints of one epoch."""
    return f"c-{device}-{epoch}"
