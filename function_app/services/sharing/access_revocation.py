"""Ending what was done under a role that somebody has lost.

At once, and not only what comes next: the lease and its epoch, what waits and what runs in their name, and the broker
sessions that hear or tell the device. Whoever takes a right away means that this person shall move nothing any more,
and a script may go on for minutes: the device holds, and nothing that waits begins by itself then.

Who acts under a share looks again after something was written (``DeviceAccess.require_still``), and here is looked after the
share was deleted: of the two at least one sees the other. All of it is safe to repeat.

What the tables decide is done in any case. The broker is waited for a moment: whoever asked is told that it did not
answer, and the timer goes on telling it.
"""

import asyncio
import contextlib
import logging
from typing import Final

from device_agent.protocol import CancelAction
from function_app.domain.actions.action import end
from function_app.domain.actions.queue import DROPPED, UNSHARED
from function_app.domain.devices.access import Share, split_target
from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Identity
from function_app.ports.broker_access import BrokerAccess, BrokerAccessError
from function_app.ports.clock import Clock
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.tables import Conflict, Tables
from function_app.services.actions.action_store import ActionStore
from function_app.services.actions.queue import ActionQueues
from function_app.services.control.fencing import ControlRevocation
from function_app.services.devices.control_rows import read_control_rows
from function_app.services.devices.device_access import DeviceAccess, share_key
from function_app.services.identity.authenticator import all_viewers
from function_app.services.messaging.command_sender import CommandSender
from function_app.services.storage import records

TELL_S: Final = 1.5
"""How long somebody who un-shares waits for the broker [s],"""
TELL_AGAIN_S: Final = 10.0
"""and how long the timer does."""
INDEX: Final = "share:"
"""Begins the keys of shares in an account's partition of ``Members``."""

_log = logging.getLogger(__name__)


class AccessRevocation:
    """Takes from an account what it may no longer have."""

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
        """End what the share's account may no longer do; whether everybody who had to be told has been.

        Args:
            share: As it was, or as it is now with less. What the account may do by another share stays.
            again: Tell devices again: who was to do it was killed, or could not reach the broker.

        Raises:
            Problem: ``busy``.
        """
        devices = await self._devices_on(share)
        until_s = asyncio.get_running_loop().time() + (TELL_AGAIN_S if again else TELL_S)
        done = await asyncio.gather(
            self._cut(share.account, until_s),
            *(self._end_at(device, share.account, until_s, again=again) for device in devices),
        )
        if await self._tables.get(records.SHARES, share.on, share_key(share.account)) is None:
            await self._unindex(share)
        return all(done)

    async def _cut(self, account: str, until_s: float) -> bool:
        """End the account's watching sessions: who has lost one device watches the others with new credentials."""
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
        # Written before it is told. Where this is not heard, the lease's release is told until it is: it holds, too.
        status, message = DROPPED[UNSHARED]
        now_ms = self._clock.now_ms()
        await self._queues.change(result.action.id, lambda existing: end(existing, status, UNSHARED, message, now_ms))
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
        """Of a space whose share is gone: the index is deleted last."""
        row = await self._tables.get(records.MEMBERS, share.account, INDEX + share.on)
        return str(row.data["owner"]) if row else ""

    async def _unindex(self, share: Share) -> None:
        row = await self._tables.get(records.MEMBERS, share.account, INDEX + share.on)
        if row is not None:
            with contextlib.suppress(Conflict):
                await self._tables.delete(records.MEMBERS, row)
        if await self._tables.get(records.SHARES, share.on, share_key(share.account)) is not None:
            # Shared again at this very moment: the index follows the share.
            await index(self._tables, share)


async def index(tables: Tables, share: Share) -> None:
    """Note with the account that something may be shared with it."""
    data = {"owner": share.owner}
    await records.upsert(tables, records.MEMBERS, share.account, INDEX + share.on, lambda _: data, dict)
