"""Acquires, renews and releases leases."""

import logging
from typing import NamedTuple

from device_agent.protocol import GrantLease, ReleaseLease, topics
from device_agent.protocol.fields import printable
from device_agent.protocol.security import setpoints, signing
from function_app.domain.actions.action import UNSHARED
from function_app.domain.common.problems import Problem
from function_app.domain.control import lease as rules
from function_app.domain.control.lease import Lease
from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Identity
from function_app.ports.clock import Clock
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import Tables
from function_app.services.control.control_events import ControlEvents
from function_app.services.control.fencing import ControlRevocation
from function_app.services.control.lease_store import LeaseStore
from function_app.services.devices.control_rows import read_control
from function_app.services.devices.device_access import DeviceAccess, require_operator, require_owner
from function_app.services.messaging.command_sender import CommandSender
from function_app.services.messaging.delivery import Confirmation

_log = logging.getLogger(__name__)


class AcquiredLease(NamedTuple):
    """A lease for its holder.

    Attributes:
        lease: The lease.
        confirmed: Whether the device confirmed it in time.
        setpoint_key: Authenticates the setpoints of the lease.
        streaming: Whether setpoints reach the device.
    """

    lease: Lease
    confirmed: bool
    setpoint_key: bytes
    streaming: bool


class Leases:
    """Leases of devices. The row decides; the device gets a signed command and checks epochs itself."""

    def __init__(
        self,
        *,
        tables: Tables,
        devices: DeviceAccess,
        lease_store: LeaseStore,
        revocation: ControlRevocation,
        command_sender: CommandSender,
        control_events: ControlEvents,
        keys: SigningKeys,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._devices = devices
        self._lease_store = lease_store
        self._revocation = revocation
        self._command_sender = command_sender
        self._control_events = control_events
        self._keys = keys
        self._clock = clock

    async def get(self, caller: Identity, device_id: str) -> Lease | None:
        """The live lease of a device, unless the device has ended it. Raises ``device-unknown``."""
        device = await self._devices.get(caller, device_id)
        control = await read_control(self._tables, device)
        lease = control.lease
        if lease is None or not lease.is_live(self._clock.now_ms()):
            return None
        return None if control.reported.ended >= lease.epoch else lease

    async def acquire(
        self, caller: Identity, device_id: str, *, epoch: int | None, lease_ms: int, wait_ms: int, over: str = ""
    ) -> AcquiredLease:
        """Acquire the lease, or renew ``epoch``.

        ``over`` is the reason for a takeover, which requires the role owner. The caller's permission on the device
        limits ``lease_ms``. Raises ``device-unknown``, ``forbidden``, ``lease-held``, ``lease-lost`` or ``busy``.
        """
        device = await self._devices.get(caller, device_id)
        what = "take control over" if over else "take control" if epoch is None else "renew control"

        def changed(lease: Lease | None, now_ms: int) -> Lease:
            for_ms = rules.granted_ms(lease_ms, device.until_ms - now_ms)
            if epoch is None:
                return rules.acquire(lease, caller, lease_ms=for_ms, now_ms=now_ms, pairing=device.pairing, over=over)
            return rules.renew(lease, caller, epoch=epoch, lease_ms=for_ms, now_ms=now_ms)

        async with self._control_events.recording_rejections(device, caller, what):
            require_operator(device)
            if over:
                require_owner(device)
            before, lease = await self._lease_store.change(caller, device, changed)
            await self.require_still_allowed(caller, device)
            result = await self.grant(device, lease, by=caller.name, wait_ms=wait_ms)
            if result.device_epoch > lease.epoch or (result.device_epoch == lease.epoch and epoch is None):
                # The tables were restored from a backup. A new lease gets a higher epoch; a renewed one is lost.
                _, lease = await self._lease_store.change(caller, device, changed, device_epoch=result.device_epoch)
                result = await self.grant(device, lease, by=caller.name, wait_ms=wait_ms)
        if before is not None and lease.reason and epoch is None:
            await self._revocation.cut(device, before.epoch)
        setpoint_key = await self._setpoint_key(device, lease.epoch)
        return AcquiredLease(lease, result.confirmed, setpoint_key, device.streaming)

    async def _setpoint_key(self, device: Device, epoch: int) -> bytes:
        """The key of a lease. The device accepts it while it pins the signing key from which it is derived."""
        return setpoints.lease_key(
            await self._keys.for_devices(),
            signing.public_key(device.agent_key),
            topic=topics.device(device.space, device.agent, device.name, topics.CTL, str(epoch)),
            pairing=device.pairing,
        )

    async def release(self, caller: Identity, device_id: str, *, epoch: int) -> None:
        """Release the lease. The device holds, and the credentials for its setpoints are revoked.

        Raises ``device-unknown``, ``forbidden``, ``lease-lost`` or ``busy``.
        """
        device = await self._devices.get(caller, device_id)

        def changed(lease: Lease | None, now_ms: int) -> Lease:
            return rules.release(rules.require_held(lease, caller, epoch=epoch, now_ms=now_ms), now_ms=now_ms)

        async with self._control_events.recording_rejections(device, caller, "give control back"):
            require_operator(device)
            await self._lease_store.change(caller, device, changed)
        # The lease is released even if the device is not reachable: its grant expires there.
        await self._command_sender.try_send(device, ReleaseLease(), caller=caller.name, epoch=epoch)
        await self._revocation.cut(device, epoch)

    async def require_still_allowed(self, caller: Identity, device: Device) -> None:
        """Check that the new holder still has permission; otherwise revoke the lease before the device gets it.

        Raises ``device-unknown`` or ``forbidden``.
        """
        try:
            await self._devices.require_still_allowed(caller, device)
        except Problem:
            await self._revocation.revoke(device, UNSHARED, account=caller.account)
            raise

    async def grant(self, device: Device, lease: Lease, *, by: str, wait_ms: int) -> Confirmation:
        """Send the lease to the device; return whether it confirmed. The lease is valid in any case."""
        order = GrantLease(
            holder=printable(lease.holder), lease_ms=lease.lease_ms, reason=lease.reason, pairing=device.pairing
        )
        try:
            return await self._command_sender.send_confirmed(
                device, order, caller=by, epoch=lease.epoch, wait_ms=wait_ms
            )
        except Problem as problem:
            _log.warning("lease of %s: %s", device.id, problem.detail)
            return Confirmation()
