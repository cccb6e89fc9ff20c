"""Taking, renewing and releasing control of a device."""

import logging
from dataclasses import replace

from device_agent.protocol.messages import GrantLease, ReleaseLease
from function_app.domain import lease as rules
from function_app.domain.accounts import Identity
from function_app.domain.devices import Device
from function_app.domain.lease import Lease
from function_app.domain.problems import Problem
from function_app.ports.broker_access import BrokerAccess, BrokerAccessError
from function_app.ports.clock import Clock
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.tables import Tables
from function_app.services.commands import Commands
from function_app.services.control import change_lease, read_lease
from function_app.services.devices import Devices

_log = logging.getLogger(__name__)


class Leases:
    """Leases of devices. The row decides; the device is told by a signed command and also decides for itself."""

    def __init__(
        self, *, tables: Tables, devices: Devices, commands: Commands, access: BrokerAccess, clock: Clock
    ) -> None:
        self._tables = tables
        self._devices = devices
        self._commands = commands
        self._access = access
        self._clock = clock

    async def get(self, who: Identity, device_id: str) -> Lease | None:
        """The live lease of a device.

        Raises:
            Problem: ``device-unknown``.
        """
        device = await self._devices.get(who, device_id)
        lease = await read_lease(self._tables, device)
        return lease if lease and lease.live(self._clock.now_ms()) else None

    async def take(
        self, who: Identity, device_id: str, *, epoch: int | None, lease_ms: int, wait_ms: int
    ) -> tuple[Lease, bool]:
        """Take the lease, or renew epoch ``epoch`` of it; and whether the device has confirmed within ``wait_ms``.

        Raises:
            Problem: ``device-unknown``, ``forbidden``, ``lease-held``, ``lease-lost``, ``busy``.
        """
        device = await self._devices.to_operate(who, device_id)

        def changed(lease: Lease | None) -> Lease:
            now_ms = self._clock.now_ms()
            if epoch is None:
                return rules.take(lease, who, lease_ms=lease_ms, now_ms=now_ms, pairing=device.pairing)
            return rules.renew(lease, who, epoch=epoch, lease_ms=lease_ms, now_ms=now_ms)

        _, lease = await change_lease(self._tables, device, changed)
        grant = GrantLease(holder=who.name, lease_ms=lease_ms)
        try:
            confirmed = await self._commands.confirmed(device, grant, who=who.name, epoch=lease.epoch, wait_ms=wait_ms)
        except Problem as problem:
            # The lease is theirs; that the device could not be told is what `confirmed` says.
            _log.warning("lease of %s: %s", device.id, problem.detail)
            confirmed = False
        return lease, confirmed

    async def release(self, who: Identity, device_id: str, *, epoch: int) -> None:
        """Give the lease back. The device holds, and credentials for this epoch's setpoints are taken back.

        Raises:
            Problem: ``device-unknown``, ``lease-lost``, ``busy``.
        """
        device = await self._devices.to_operate(who, device_id)

        def changed(lease: Lease | None) -> Lease:
            current = rules.hold(lease, who, epoch=epoch, now_ms=self._clock.now_ms())
            return replace(rules.release(current), pairing=device.pairing)

        await change_lease(self._tables, device, changed)
        # Released it is, whoever can be told: what the device was granted ends with the time it was granted for.
        try:
            await self._commands.send(device, ReleaseLease(), who=who.name, epoch=epoch)
        except BusUnavailable as error:
            _log.warning("release of %s: %s", device.id, error)
        await self._revoke(device, epoch)

    async def _revoke(self, device: Device, epoch: int) -> None:
        """Take back the credentials that carry this epoch's setpoints: fencing that does not need the device."""
        try:
            await self._access.revoke(client_id=control_client(device.id, epoch))
        except BrokerAccessError as error:
            _log.warning("setpoints of lease %d of %s: %s", epoch, device.id, error)


def control_client(device: str, epoch: int) -> str:
    """The MQTT client id of the connection that carries one epoch's setpoints."""
    return f"c-{device}-{epoch}"
