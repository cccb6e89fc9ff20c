"""Revokes what an account did with permissions that it has lost.

Lease, queued and running actions, and broker connections end. The device holds and starts no queued action.

Users of a share write first and check the share again (``DeviceAccess.require_still_allowed``). This module runs after
the share was deleted, so at least one of both sees the other. All steps are idempotent.

The tables are changed in any case. If the broker does not respond within a short time, the caller is informed and the
timer retries.
"""

import asyncio
import logging
from typing import Final

from device_agent.protocol import CancelAction
from function_app.domain.actions.action import UNSHARED, withdraw
from function_app.domain.actions.queue import DROPPED
from function_app.domain.devices.access import Share, split_target
from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Identity
from function_app.ports.broker_access import BrokerAccess, BrokerAccessError
from function_app.ports.clock import Clock
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.tables import Tables
from function_app.services.actions.action_store import ActionStore
from function_app.services.actions.queue import ActionQueues
from function_app.services.control.fencing import ControlRevocation
from function_app.services.devices.control_rows import read_control_rows
from function_app.services.devices.device_access import DeviceAccess, share_key
from function_app.services.identity.authenticator import all_viewers
from function_app.services.messaging.command_sender import CommandSender
from function_app.services.storage import records

NOTIFY_S: Final = 1.5
"""Time limit for the broker when a caller waits [s]."""
RETRY_NOTIFY_S: Final = 10.0
"""Time limit for the broker when the timer retries [s]."""
INDEX: Final = "share:"
"""Key prefix of shares in an account's partition of ``Members``."""

_log = logging.getLogger(__name__)


class AccessRevocation:
    """Revokes lost permissions of an account."""

    def __init__(
        self,
        *,
        tables: Tables,
        devices: DeviceAccess,
        action_store: ActionStore,
        queues: ActionQueues,
        command_sender: CommandSender,
        revocation: ControlRevocation,
        access: BrokerAccess,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._devices = devices
        self._action_store = action_store
        self._queues = queues
        self._command_sender = command_sender
        self._revocation = revocation
        self._access = access
        self._clock = clock

    async def settle(self, share: Share, *, again: bool = False) -> bool:
        """Revoke permissions that the share's account has lost; return whether broker and devices were notified.

        Args:
            share: The deleted or reduced share. Permissions of other shares remain.
            again: Notify again after an interrupted or failed attempt.

        Raises:
            Problem: ``busy``.
        """
        devices = await self._devices_on(share)
        until_s = asyncio.get_running_loop().time() + (RETRY_NOTIFY_S if again else NOTIFY_S)
        done = await asyncio.gather(
            self._close_viewers(share.account, until_s),
            *(self._end_at(device, share.account, until_s, again=again) for device in devices),
        )
        if await self._tables.get(records.SHARES, share.on, share_key(share.account)) is None:
            await self._unindex(share)
        return all(done)

    async def _close_viewers(self, account: str, until_s: float) -> bool:
        """Close the account's viewing connections; new credentials cover its remaining devices."""
        try:
            async with asyncio.timeout_at(until_s):
                await self._access.revoke(principal=all_viewers(account))
        except (BrokerAccessError, TimeoutError) as error:
            _log.warning("sessions of %s: %s", account, str(error) or "the broker did not answer in time")
            return False
        return True

    async def _end_at(self, device: Device, account: str, until_s: float, *, again: bool) -> bool:
        caller = Identity(account, "", "")
        result, _ = await self._devices.find_with_link(caller, device.id)
        if result is not None and result.role.may_operate:
            return True
        done = await self._revocation.revoke(device, UNSHARED, account=account, until_s=until_s)
        if again:
            done = await self._revocation.retry(device, account, until_s=until_s) and done
        return await self._end_actions(device, account, until_s) and done

    async def _end_actions(self, device: Device, account: str, until_s: float) -> bool:
        control = await read_control_rows(self._tables, device.id)
        waiting = []
        for action in control.queue.actions:
            result = await self._action_store.get(action)
            if result is not None and result.action.account == account:
                waiting.append(action)
        if waiting:
            await self._queues.cancel(device.id, waiting, UNSHARED)
        result = await self._action_store.get(control.action) if control.action else None
        if result is None or result.action.account != account or result.action.pairing != device.pairing:
            return True
        # Stored before it is sent. If it is lost, the repeated release of the lease also stops the action.
        _, message = DROPPED[UNSHARED]
        now_ms = self._clock.now_ms()
        await self._queues.change(result.action.id, lambda existing: withdraw(existing, UNSHARED, message, now_ms))
        epoch = max(control.lease.epoch if control.lease else 0, result.action.epoch)
        try:
            async with asyncio.timeout_at(until_s):
                await self._command_sender.send(
                    device, CancelAction(action=result.action.id), caller="telescope", epoch=epoch
                )
        except (BusUnavailable, TimeoutError) as error:
            _log.warning("end of action %s: %s", result.action.id, str(error) or "the broker did not answer in time")
            return False
        return True

    async def _devices_on(self, share: Share) -> list[Device]:
        kind, name = split_target(share.on)
        if kind == "device":
            device = await self._devices.get_as_owner(name)
            return [] if device is None else [device]
        owner = share.owner or await self._owner_in_index(share)
        return await self._devices.in_space(owner, name) if owner else []

    async def _owner_in_index(self, share: Share) -> str:
        """The owner of a space whose share is deleted; the index is deleted last."""
        row = await self._tables.get(records.MEMBERS, share.account, INDEX + share.on)
        return str(row.data["owner"]) if row else ""

    async def _unindex(self, share: Share) -> None:
        await records.remove(self._tables, records.MEMBERS, share.account, INDEX + share.on)
        if await self._tables.get(records.SHARES, share.on, share_key(share.account)) is not None:
            # Shared again concurrently: the index follows the share.
            await index(self._tables, share)


async def index(tables: Tables, share: Share) -> None:
    """List a share in the account's index."""
    data = {"owner": share.owner}
    await records.upsert(tables, records.MEMBERS, share.account, INDEX + share.on, lambda _: data, dict)
