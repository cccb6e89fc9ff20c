"""Looking at actions, waiting for them, cancelling them."""

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
from function_app.services.actions.action_store import ActionRows, Found
from function_app.services.devices.control_rows import read_lease
from function_app.services.devices.device_access import Devices, require_operator
from function_app.services.messaging.command_sender import Commands
from function_app.services.messaging.delivery import Delivery


class Actions:
    """Actions that exist."""

    def __init__(
        self,
        *,
        tables: Tables,
        devices: Devices,
        rows: ActionRows,
        acks: ActionAcks,
        commands: Commands,
        delivery: Delivery,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._devices = devices
        self._rows = rows
        self._acks = acks
        self._commands = commands
        self._delivery = delivery
        self._clock = clock

    async def list(
        self, who: Identity, device: str, *, cursor: str | None, limit: int
    ) -> tuple[list[Action], str | None]:
        """A device's actions, newest first.

        Raises:
            Problem: ``device-unknown``, ``cursor-invalid``.
        """
        return await self._rows.list(await self._devices.get(who, device), cursor=cursor, limit=limit)

    async def get(self, who: Identity, action: str, *, wait_ms: int, wait_for: Literal["started", "done"]) -> Action:
        """One action, as soon as it has come as far as ``wait_for``, or as it is after ``wait_ms``.

        Raises:
            Problem: ``action-unknown``.
        """
        device, found = await self._find(who, action)
        if not wait_ms or found.action.status.terminal:
            return found.action
        async with self._delivery.acks(device, action) as acks:
            found = await self._rows.get(action) or found
            return await self._acks.follow(found, acks, wanted=Status(wait_for), wait_ms=wait_ms)

    async def cancel(self, who: Identity, action: str) -> Action:
        """Ask the device to end an action; one that waits for its turn ends at once. It has ended when it says so.

        Raises:
            Problem: ``action-unknown``, ``forbidden``, ``broker-unavailable``, ``busy``.
        """
        device, found = await self._find(who, action)
        require_operator(device)
        if found.action.status.terminal:
            return found.action
        cancel_id = command_id(device.id, self._clock.now_ms())
        now_ms = self._clock.now_ms()
        marked = await self._rows.change(action, lambda known: _cancelling(known, cancel_id, now_ms), known=found)
        if marked is not None and marked.action.status.terminal:
            return marked.action
        lease = await read_lease(self._tables, device)
        epoch = max((marked or found).action.epoch, lease.epoch if lease else 0)
        try:
            await self._commands.send(device, CancelAction(action=action), who=who.name, epoch=epoch)
        except BusUnavailable as error:
            raise broker_unavailable(f"{error}.") from error
        return (marked or found).action

    async def _find(self, who: Identity, action: str) -> tuple[Device, Found]:
        parts = split_command(action)
        found = await self._rows.get(action) if parts else None
        if parts is None or found is None:
            raise not_found("action", action)
        device = await self._device(who, parts[0], action)
        if found.action.pairing != device.pairing:
            raise not_found("action", action)
        return device, found

    async def _device(self, who: Identity, device: str, action: str) -> Device:
        visible, _ = await self._devices.find(who, device)
        if visible is None:
            raise not_found("action", action)
        return visible


def _cancelling(action: Action, cancel_id: str, now_ms: int) -> Action:
    if action.status is Status.QUEUED:
        return end(action, Status.CANCELLED, "cancelled", "Cancelled before its turn came.", now_ms)
    if action.status.terminal or action.cancel_id:
        return action
    return replace(action, cancel_id=cancel_id)
