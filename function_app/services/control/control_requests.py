"""Requests for control, and the answers of the holder."""

import asyncio
import logging
from collections.abc import Callable

from device_agent.protocol import RequestControl, WithdrawRequest
from device_agent.protocol.fields import printable
from function_app.domain.common.ids import new_id
from function_app.domain.common.problems import Problem
from function_app.domain.control import control_request as rules
from function_app.domain.control.lease import ControlRequest, Lease
from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Identity
from function_app.domain.identity.api_keys import key_of
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.control.control_events import ControlEvents
from function_app.services.control.fencing import ControlRevocation
from function_app.services.control.lease_store import LeaseStore
from function_app.services.control.leases import Leases
from function_app.services.devices.control_rows import read_lease
from function_app.services.devices.device_access import DeviceAccess, require_operator
from function_app.services.messaging.command_sender import CommandSender
from function_app.services.messaging.delivery import Confirmation

_log = logging.getLogger(__name__)


class ControlRequests:
    """Requests for control. The lease's row decides; the device shows the request to all viewers."""

    def __init__(
        self,
        *,
        tables: Tables,
        devices: DeviceAccess,
        leases: Leases,
        revocation: ControlRevocation,
        lease_store: LeaseStore,
        command_sender: CommandSender,
        control_events: ControlEvents,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._devices = devices
        self._leases = leases
        self._revocation = revocation
        self._lease_store = lease_store
        self._command_sender = command_sender
        self._control_events = control_events
        self._clock = clock

    async def get(self, caller: Identity, device_id: str, request: str) -> tuple[Lease, ControlRequest]:
        """The last request for control of a device, and its lease. Raises ``device-unknown`` or ``request-unknown``."""
        device = await self._devices.get(caller, device_id)
        return rules.find(await read_lease(self._tables, device), request)

    async def create(
        self, caller: Identity, device_id: str, *, within_ms: int, lease_ms: int, wait_ms: int
    ) -> tuple[Lease, ControlRequest, bool, bool]:
        """Request control from the holder, who has ``within_ms`` to answer.

        Returns:
            The lease, the request, whether it is new, and whether the device shows it after at most ``wait_ms``.

        Raises:
            Problem: ``device-unknown``, ``forbidden``, ``lease-free``, ``lease-already-held``, ``lease-requested``,
                ``busy``.
        """
        device = await self._devices.get(caller, device_id)
        created = new_id()

        def changed(lease: Lease | None, now_ms: int) -> Lease:
            return rules.request_control(
                lease, caller, request=created, within_ms=within_ms, lease_ms=lease_ms, now_ms=now_ms
            )

        async with self._control_events.recording_rejections(device, caller, "ask for control"):
            require_operator(device)
            _, lease = await self._lease_store.change(caller, device, changed)
        control_request = lease.request
        assert control_request is not None  # noqa: S101 (the rule has just written it)
        left_ms = max(1, control_request.expires_ms - self._clock.now_ms())
        order = RequestControl(
            request=control_request.id, requester=printable(control_request.by), answer_within_ms=left_ms
        )
        try:
            confirmation = await self._command_sender.send_confirmed(
                device, order, caller=caller.name, epoch=lease.epoch, wait_ms=wait_ms
            )
        except Problem as problem:
            _log.warning("request for %s: %s", device.id, problem.detail)
            confirmation = Confirmation()
        return lease, control_request, control_request.id == created, confirmation.confirmed

    async def accept(
        self, caller: Identity, device_id: str, request: str, *, wait_ms: int
    ) -> tuple[Lease, ControlRequest, bool]:
        """Transfer control to the requester in one write, with the next epoch. Moving joints are held.

        Returns:
            The lease, the request, and whether the device confirmed it within ``wait_ms``.

        Raises:
            Problem: ``device-unknown``, ``forbidden``, ``request-unknown``, ``control-request-closed``,
                ``requester-offline``, ``busy``.
        """
        device = await self._devices.get(caller, device_id)
        async with self._control_events.recording_rejections(device, caller, "hand control over"):
            require_operator(device)
            await self._require_requester(device, request)
            before, lease = await self._change(caller, device, rules.accept, request)
            if before is not lease:
                await self._require_requester_still_allowed(device, lease)
        _, control_request = rules.find(lease, request)
        if before is lease or before is None:
            # Accepted by an earlier call. Each renewal announces the lease to the device.
            return lease, control_request, False
        confirmation, _ = await asyncio.gather(
            self._leases.grant(device, lease, by=caller.name, wait_ms=wait_ms),
            self._revocation.cut(device, before.epoch),
        )
        return lease, control_request, confirmation.confirmed

    async def reject(self, caller: Identity, device_id: str, request: str) -> tuple[Lease, ControlRequest]:
        """Reject the request.

        Raises ``device-unknown``, ``forbidden``, ``request-unknown``, ``control-request-closed`` or ``busy``.
        """
        device = await self._devices.get(caller, device_id)
        async with self._control_events.recording_rejections(device, caller, "reject a control request"):
            require_operator(device)
            before, lease = await self._change(caller, device, rules.reject, request)
        if before is not lease:
            await self._drop(caller, device, lease, request)
        return rules.find(lease, request)

    async def withdraw(self, caller: Identity, device_id: str, request: str) -> None:
        """Withdraw the request.

        Raises ``device-unknown``, ``forbidden``, ``request-unknown``, ``control-request-closed`` or ``busy``.
        """
        device = await self._devices.get(caller, device_id)
        async with self._control_events.recording_rejections(device, caller, "withdraw a request for control"):
            before, lease = await self._change(caller, device, rules.withdraw, request)
        if before is not lease:
            await self._drop(caller, device, lease, request)

    async def _change(
        self, caller: Identity, device: Device, rule: Callable[..., Lease], request: str
    ) -> tuple[Lease | None, Lease]:
        return await self._lease_store.change(
            caller, device, lambda lease, now_ms: rule(lease, caller, request=request, now_ms=now_ms)
        )

    async def _require_requester(self, device: Device, request: str) -> None:
        """Check that the requester is signed in and may operate. The rule handles closed requests."""
        lease, control_request = rules.find(await read_lease(self._tables, device), request)
        if control_request.current_outcome(lease, self._clock.now_ms()) != "open":
            return
        requester = await self._devices.current_identity(
            Identity(control_request.account, control_request.by, control_request.session)
        )
        result = (await self._devices.find_with_link(requester, device.id))[0] if requester is not None else None
        if result is None or not result.role.may_operate:
            raise _requester_offline(control_request.by, "You keep control.")

    async def _require_requester_still_allowed(self, device: Device, lease: Lease) -> None:
        requester = Identity(lease.account, lease.holder, lease.session, key=key_of(lease.session))
        try:
            await self._leases.require_still_allowed(requester, device)
        except Problem as problem:
            raise _requester_offline(lease.holder, "The lease is free now.") from problem

    async def _drop(self, caller: Identity, device: Device, lease: Lease, request: str) -> None:
        """Remove the request from the device's state, best effort: it also expires there."""
        order = WithdrawRequest(request=request)
        await self._command_sender.try_send(device, order, caller=caller.name, epoch=lease.epoch)


def _requester_offline(by: str, then: str) -> Problem:
    detail = f"{by} has signed out, or may no longer operate this device. {then}"
    return Problem("requester-offline", 409, "The requester is not available", detail)
