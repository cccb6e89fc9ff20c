"""Publishes the command of a stored action. Equal rows give equal commands, so the device drops duplicates."""

import msgspec

from device_agent.protocol import RunMovement, RunTrial, Task
from function_app.domain.actions.action import ASK_MS, KEY_ENDED, SIGNED_OUT, UNSHARED, Action, mark_published
from function_app.domain.actions.queue import DROPPED, UNPAIRED
from function_app.domain.common.ids import split_command, split_device
from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import Agent, Device, Link
from function_app.domain.identity.accounts import Identity
from function_app.domain.identity.api_keys import key_of
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.actions.action_store import ActionStore, StoredAction
from function_app.services.actions.trial_log import KIND
from function_app.services.devices.device_access import DeviceAccess, devices_of, require_online
from function_app.services.messaging.command_sender import CommandSender
from function_app.services.robot_types.movements import Movements
from function_app.services.storage import records


class MovementUnavailable(Exception):  # noqa: N818 (an outcome that callers expect)
    """The pinned script was deleted."""


class PermissionEnded(Exception):  # noqa: N818 (an outcome that callers expect)
    """The account may no longer run the action; ``why`` is a key of ``DROPPED``."""

    def __init__(self, why: str) -> None:
        super().__init__(DROPPED[why][1])
        self.why = why


class ActionDispatcher:
    """Publishes stored actions: those that leave the queue, and unanswered ones."""

    def __init__(
        self,
        *,
        tables: Tables,
        devices: DeviceAccess,
        action_store: ActionStore,
        command_sender: CommandSender,
        movements: Movements,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._devices = devices
        self._action_store = action_store
        self._command_sender = command_sender
        self._movements = movements
        self._clock = clock

    async def device(self, action: Action) -> Device | None:
        """The action's device, if the agent still has the same pairing."""
        parts = split_device((split_command(action.id) or ("", ""))[0])
        row = await self._tables.get(records.AGENTS, parts[0], "agent") if parts else None
        if row is None:
            return None
        agent = records.read(row, Agent)
        if agent.pairing != action.pairing:
            return None
        return next((device for device in devices_of(agent) if device.id == action.device), None)

    async def current_permissions(self, action: Action) -> tuple[Identity, Device]:
        """The current identity and device of an action, read again because it may have been queued for long.

        Raises:
            PermissionEnded: The device was removed or has another owner, share or key have ended or changed, or the
                account has signed out.
        """
        caller = await self._devices.current_identity(Identity(action.account, action.caller, action.session))
        device, _ = (None, None) if caller is None else await self._devices.find_with_link(caller, action.device)
        if caller is not None and device is not None and device.pairing == action.pairing and device.role.may_operate:
            return caller, device
        if await self.device(action) is None:
            raise PermissionEnded(UNPAIRED)
        if key_of(action.session):
            raise PermissionEnded(KEY_ENDED)
        raise PermissionEnded(SIGNED_OUT if caller is None else UNSHARED)

    async def send(self, stored: StoredAction, device: Device) -> None:
        """Publish the command and record it.

        Raises:
            MovementUnavailable: The script is not available.
            PermissionEnded: The account may no longer run the action.
            BusUnavailable: The broker did not confirm the command.
        """
        action = stored.action
        await self.current_permissions(action)
        await self._command_sender.send_action(device, await self._command(action), action)
        now_ms = self._clock.now_ms()
        await self._action_store.change(action.id, lambda existing: mark_published(existing, now_ms), existing=stored)

    async def ask(self, action: Action, device: Device) -> None:
        """Publish the expired command again, unless the device is offline.

        The device never starts it, so the caller's permissions are not checked. It repeats its last ack, or reports
        that the command has expired.

        Raises:
            MovementUnavailable: The script is not available.
            BusUnavailable: The broker did not confirm the command.
        """
        now_ms = self._clock.now_ms()
        _, link = await records.find(self._tables, records.AGENTS, device.agent, "link", Link)
        try:
            require_online(link, now_ms)
        except Problem:
            return
        command = await self._command(action)
        await self._command_sender.send_action(device, command, action, until_ms=now_ms + ASK_MS)

    async def _command(self, action: Action) -> Task | RunMovement | RunTrial:
        request = action.request
        if request["kind"] == "run_movement":
            return await self._movement(action, request["name"])
        if request["kind"] == KIND:
            movement = await self._movement(action, request["movement"])
            return RunTrial(
                name=request["name"], tasks_sha256=request["tasks_sha256"], seed=request["seed"], movement=movement
            )
        task: Task = msgspec.convert(request, Task)
        return task

    async def _movement(self, action: Action, name: str) -> RunMovement:
        # A shared device runs its owner's movements, so the author's store contains the script.
        owner = Identity(action.pinned["author"] or action.account, action.caller, "")
        source = await self._movements.pinned_source(owner, name, action.pinned)
        if source is None:
            raise MovementUnavailable
        return RunMovement(
            **action.pinned,
            name=name,
            source=source,
            parameters=action.request["parameters"],
            timeout_ms=action.timeout_ms,
        )
