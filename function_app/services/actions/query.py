"""Reads, awaits and cancels actions."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

from device_agent.protocol import CancelAction
from function_app.domain.actions.action import Action, Status, end
from function_app.domain.common.ids import command_id, split_command
from function_app.domain.common.problems import broker_unavailable, not_found
from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Identity
from function_app.ports.clock import Clock
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.tables import Tables
from function_app.services.actions.acks import ActionAcks
from function_app.services.actions.action_store import ActionStore, StoredAction
from function_app.services.devices.control_rows import read_lease
from function_app.services.devices.device_access import DeviceAccess, require_operator
from function_app.services.messaging.command_sender import CommandSender
from function_app.services.messaging.delivery import Delivery


class Actions:
    """Existing actions."""

    def __init__(
        self,
        *,
        tables: Tables,
        devices: DeviceAccess,
        action_store: ActionStore,
        acks: ActionAcks,
        command_sender: CommandSender,
        delivery: Delivery,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._devices = devices
        self._action_store = action_store
        self._acks = acks
        self._command_sender = command_sender
        self._delivery = delivery
        self._clock = clock

    async def list(
        self, caller: Identity, device: str, *, cursor: str | None, limit: int
    ) -> tuple[Sequence[Action], str | None]:
        """A device's actions, newest first. Raises ``device-unknown`` or ``cursor-invalid``."""
        return await self._action_store.list(await self._devices.get(caller, device), cursor=cursor, limit=limit)

    async def get(self, caller: Identity, action: str, *, wait_ms: int, wait_for: Literal["started", "done"]) -> Action:
        """One action, after it reached ``wait_for`` or after ``wait_ms``. Raises ``action-unknown``."""
        device, stored = await self._find(caller, action)
        if not wait_ms or stored.action.status.terminal:
            return stored.action
        async with self._delivery.acks(device, action) as acks:
            stored = await self._action_store.get(action) or stored
            return await self._acks.follow(stored, acks, target=Status(wait_for), wait_ms=wait_ms)

    async def cancel(self, caller: Identity, action: str) -> Action:
        """Request the device to cancel an action. Queued actions end immediately, others when the device reports it.

        Raises ``action-unknown``, ``forbidden``, ``broker-unavailable`` or ``busy``.
        """
        device, stored = await self._find(caller, action)
        require_operator(device)
        if stored.action.status.terminal:
            return stored.action
        cancel_id = command_id(device.id, self._clock.now_ms())
        now_ms = self._clock.now_ms()
        marked = await self._action_store.change(
            action, lambda existing: _cancelling(existing, cancel_id, now_ms), existing=stored
        )
        if marked is not None and marked.action.status.terminal:
            return marked.action
        lease = await read_lease(self._tables, device)
        epoch = max((marked or stored).action.epoch, lease.epoch if lease else 0)
        try:
            await self._command_sender.send(device, CancelAction(action=action), caller=caller.name, epoch=epoch)
        except BusUnavailable as error:
            raise broker_unavailable(f"{error}.") from error
        return (marked or stored).action

    async def _find(self, caller: Identity, action: str) -> tuple[Device, StoredAction]:
        parts = split_command(action)
        stored = await self._action_store.get(action) if parts else None
        if parts is None or stored is None:
            raise not_found("action", action)
        device = await self._device(caller, parts[0], action)
        if stored.action.pairing != device.pairing:
            raise not_found("action", action)
        return device, stored

    async def _device(self, caller: Identity, device: str, action: str) -> Device:
        visible, _ = await self._devices.find_with_link(caller, device)
        if visible is None:
            raise not_found("action", action)
        return visible


def _cancelling(action: Action, cancel_id: str, now_ms: int) -> Action:
    if action.status is Status.QUEUED:
        return end(action, Status.CANCELLED, "cancelled", "Cancelled while it was queued.", now_ms)
    if action.status.terminal or action.cancel_id:
        return action
    return replace(action, cancel_id=cancel_id)
