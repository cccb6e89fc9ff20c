"""Starts actions: writes action, slot and lease in one batch, publishes the command and waits for the acks."""

import hashlib
import secrets
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager, AsyncExitStack, nullcontext
from dataclasses import replace
from typing import Any

import msgspec

from device_agent.protocol import MAX_SEED, Ack, CollectData, RunMovement, RunTrial, Task
from device_agent.protocol.manifests.tasks import Task as SceneTask
from function_app.domain.actions.action import KEY_ENDED, RETRY_MS, UNSHARED, Action, Status, end, reached
from function_app.domain.actions.queue import DROPPED
from function_app.domain.common.ids import command_id
from function_app.domain.common.problems import Problem, busy_store, invalid
from function_app.domain.control import lease as rules
from function_app.domain.control.lease import Lease
from function_app.domain.devices.devices import Device, Link
from function_app.domain.identity.accounts import Identity
from function_app.ports.clock import Clock
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.monitoring import Tracing
from function_app.ports.tables import Row, Tables, Write
from function_app.services.actions import capability_check
from function_app.services.actions.acks import ActionAcks, Publication
from function_app.services.actions.action_store import ActionStore, StoredAction, new_row
from function_app.services.actions.queue import ActionQueues, action_lease
from function_app.services.actions.requests import ActionRequest, AskMovement, AskTrial
from function_app.services.actions.tasks import RobotTypeTasks
from function_app.services.control.control_events import ControlEvents, lease_change
from function_app.services.devices.control_rows import ControlRows, apply_device_epochs, read_control
from function_app.services.devices.device_access import DeviceAccess, require_online, require_operator
from function_app.services.messaging.command_sender import CommandSender
from function_app.services.messaging.delivery import Delivery
from function_app.services.robot_types import parameter_schema as parameters
from function_app.services.robot_types.movements import Movements
from function_app.services.storage import records
from function_app.services.storage.reminders import Reminders

ABANDON_MS = 30_000
"""A start that is not written after this time is rejected, because its reminder may have been deleted."""
PINNED = ("robot_type", "version", "sha256", "author", "key", "signature")
"""Fields of the movement that an action stores, so that a republished command is identical."""

TRIAL_MARGIN_S = 15.0
"""Time for reset and verdict of a trial, in addition to the time limit of its task [s]."""

_Pending = tuple[StoredAction, AsyncIterator[Ack] | None, Publication | None]
"""A stored action, its acks, and the publication of its command if this request published it."""


class _Undelivered(Exception):  # noqa: N818 (an outcome, not a fault)
    """The action is stored, but the broker did not confirm its command. The timer publishes it again."""

    def __init__(self, action: Action) -> None:
        super().__init__(action.id)
        self.action = action


class StartAction:
    """Starts one action on one device."""

    def __init__(
        self,
        *,
        tables: Tables,
        devices: DeviceAccess,
        movements: Movements,
        tasks: RobotTypeTasks,
        command_sender: CommandSender,
        action_store: ActionStore,
        acks: ActionAcks,
        reminders: Reminders,
        queues: ActionQueues,
        delivery: Delivery,
        control_events: ControlEvents,
        tracing: Tracing,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._devices = devices
        self._movements = movements
        self._tasks = tasks
        self._command_sender = command_sender
        self._action_store = action_store
        self._acks = acks
        self._reminders = reminders
        self._queues = queues
        self._delivery = delivery
        self._control_events = control_events
        self._tracing = tracing
        self._clock = clock

    async def start(
        self,
        caller: Identity,
        device_id: str,
        request: ActionRequest,
        *,
        idempotency_key: str = "",
        gate: AbstractAsyncContextManager[object] | None = None,
    ) -> tuple[Action, bool]:
        """Start an action; also return whether it reached ``wait_for``, or ended, within ``wait_ms``.

        If this process is killed after any write, the timer publishes or ends the action.

        Args:
            caller: The account that starts the action.
            device_id: The device.
            request: What to run.
            idempotency_key: Requests with the same key start one action; empty: no key.
            gate: Held while the action is written and published, not while its acks are awaited.

        Raises:
            Problem: ``device-unknown``, ``forbidden``, ``movement-unknown``, ``device-offline``, ``device-busy``,
                ``queue-full``, ``lease-held``, ``lease-lost``, ``idempotency-key-reused``, ``busy``,
                ``parameters-invalid``, ``unable``, ``invalid``.
        """
        if isinstance(request.request, AskMovement):
            parameters.check(request.request.parameters)
        target = Status(request.wait_for)
        async with AsyncExitStack() as stack:
            try:
                async with gate or nullcontext():
                    with self._tracing.span("check access"):
                        device, link = await self._devices.get_with_link(caller, device_id)
                    async with self._control_events.recording_rejections(device, caller, "start an action"):
                        key = _key(caller, device, idempotency_key)
                        stored, acks, published = await self._begin(caller, device, link, request, key, stack)
            except _Undelivered as undelivered:
                return undelivered.action, False
            action = await self._acks.follow(stored, acks, target=target, wait_ms=request.wait_ms, published=published)
        return action, reached(action, target)

    async def _begin(  # noqa: PLR0917 (the request and its context)
        self,
        caller: Identity,
        device: Device,
        link: Link | None,
        request: ActionRequest,
        key: str,
        stack: AsyncExitStack,
    ) -> _Pending:
        require_operator(device)
        existing = await self._existing(device, request, key) if key else None
        if existing is not None:
            return await self._join(existing, device, stack)
        now_ms = self._clock.now_ms()
        require_online(link, now_ms)
        action_id = command_id(device.id, now_ms)
        task, stored_request, pinned = await self._task(device, request)
        kind = str(type(task).__struct_config__.tag)
        if link is not None and link.capabilities and kind not in link.capabilities:
            detail = f"The device's agent does not support the request '{kind}'. Update the agent."
            raise Problem("unable", 422, "The device cannot do this", detail)
        # Validated before any write: a command that cannot be sent must not occupy the slot.
        traceparent = self._tracing.current()
        command = self._command_sender.validated(device, action_id, task, caller=caller.name, traceparent=traceparent)
        draft = Action(
            id=action_id,
            device=device.id,
            account=caller.account,
            caller=caller.name,
            pairing=device.pairing,
            request=stored_request,
            epoch=0,
            created_ms=now_ms,
            ttl_ms=min(request.ttl_ms, request.timeout_ms),
            deadline_ms=now_ms + request.timeout_ms,
            pinned=pinned,
            idempotency_key=key,
            session=caller.session,
            timeout_ms=request.timeout_ms,
            reissuable=request.epoch is None,
            traceparent=traceparent,
        )
        with self._tracing.span("write action, slot and lease"):
            await self._reminders.schedule(action_id, now_ms + RETRY_MS)
            if request.policy == "queue":
                await self._queues.schedule_check(device.id)
            stored, created = await self._write(caller, device, draft, request)
        action = stored.action
        if created and action.status is Status.QUEUED:
            await self._queues.advance(device.id)
        if not created or action.status is Status.QUEUED:
            return await self._join(stored, device, stack)
        await self._require_still_allowed(caller, device, stored)
        signed = await self._command_sender.sign(
            msgspec.structs.replace(command, epoch=action.epoch, issued_at_ms=action.created_ms, ttl_ms=action.ttl_ms)
        )
        acks = await stack.enter_async_context(self._delivery.acks(device, action.id))
        # Read before the command is sent: the device may answer before the broker confirms it.
        published = Publication(self._clock.now_ms(), device.transport)
        try:
            await self._delivery.send(device, signed)
        except BusUnavailable as error:
            raise _Undelivered(action) from error
        return stored, acks, published

    async def _require_still_allowed(self, caller: Identity, device: Device, stored: StoredAction) -> None:
        """End the action if the caller lost access to the device while it was written.

        Raises ``device-unknown`` or ``forbidden``.
        """
        try:
            await self._devices.require_still_allowed(caller, device)
        except Problem:
            why = KEY_ENDED if caller.key else UNSHARED
            status, message = DROPPED[why]
            now_ms = self._clock.now_ms()
            await self._queues.change(
                stored.action.id, lambda action: end(action, status, why, message, now_ms), existing=stored
            )
            raise

    async def _join(self, stored: StoredAction, device: Device, stack: AsyncExitStack) -> _Pending:
        """Follow an action that an earlier request started, or that is queued."""
        acks = await stack.enter_async_context(self._delivery.acks(device, stored.action.id))
        return await self._action_store.get(stored.action.id) or stored, acks, None

    async def _task(
        self, device: Device, request: ActionRequest
    ) -> tuple[RunMovement | RunTrial | Task, dict[str, Any], dict[str, Any]]:
        """The task for the device, the request as stored, and the pinned fields of a movement."""
        task = request.request
        stored_request: dict[str, Any] = msgspec.to_builtins(task)
        if isinstance(task, Task):
            if isinstance(task, CollectData) and task.duration_s * 1000 > request.timeout_ms:
                raise invalid("Collecting data takes longer than timeout_ms. Raise timeout_ms, or lower duration_s.")
            await capability_check.check(self._tables, device, task)
            return task, stored_request, {}
        if isinstance(task, AskTrial):
            trial = await self._trial(device, task, request.timeout_ms)
            stored_request |= {"seed": trial.seed, "tasks_sha256": trial.tasks_sha256}
            stored_request |= {"movement": trial.movement.name, "parameters": trial.movement.parameters}
            return trial, stored_request, _pinned(trial.movement)
        run = await self._movement(device, task.name, task.parameters, request.timeout_ms)
        # Stored with the default values: a republished command must be identical.
        stored_request["parameters"] = run.parameters
        return run, stored_request, _pinned(run)

    async def _trial(self, device: Device, trial: AskTrial, timeout_ms: int) -> RunTrial:
        manifest, task = await self._tasks.get(Identity(device.owner, "", ""), device.robot_type, trial.name)
        needed_ms = round((task.time_limit_s + TRIAL_MARGIN_S) * 1000)
        if timeout_ms < needed_ms:
            raise invalid(f"A trial of '{trial.name}' needs a timeout_ms of at least {needed_ms}.")
        seed = trial.seed
        if seed is None and isinstance(task, SceneTask) and manifest.objects:
            seed = secrets.randbelow(MAX_SEED + 1)
        movement = await self._movement(device, task.movement, task.parameters, timeout_ms)
        return RunTrial(name=task.name, tasks_sha256=manifest.sha256, seed=seed, movement=movement)

    async def _movement(self, device: Device, name: str, given: dict[str, Any], timeout_ms: int) -> RunMovement:
        """The newest version of a movement. A device runs those of its owner, also when another account starts them."""
        owner = Identity(device.owner, "", "")
        movement, source = await self._movements.get(owner, device.robot_type, name)
        return RunMovement(
            robot_type=device.robot_type,
            name=movement.name,
            version=movement.version,
            sha256=movement.sha256,
            source=source,
            parameters=parameters.fit(movement.parameters_schema, given),
            author=movement.author or device.owner,
            key=movement.key,
            signature=movement.signature,
            timeout_ms=timeout_ms,
        )

    async def _write(
        self, caller: Identity, device: Device, draft: Action, request: ActionRequest
    ) -> tuple[StoredAction, bool]:
        """Write action, slot, lease and idempotency row in one batch; ``False``: the action of the key exists."""

        async def attempt() -> tuple[StoredAction, bool]:
            now_ms = self._clock.now_ms()
            control = await read_control(self._tables, device)
            control = apply_device_epochs(control, caller, now_ms)
            if now_ms - draft.created_ms > ABANDON_MS:
                raise busy_store()
            existing = await self._existing(device, request, draft.idempotency_key) if draft.idempotency_key else None
            if existing is not None:
                return existing, False
            before = control.action or next(iter((*control.queue.actions, *control.queue.dropped)), "")
            lease = _lease(caller, control, draft, request, before, now_ms)
            action = draft if lease is None else replace(draft, epoch=lease.epoch)
            if before:
                action = replace(
                    action,
                    status=Status.QUEUED,
                    deadline_ms=draft.deadline_ms + request.queue_ms,
                    queued_until_ms=draft.created_ms + request.queue_ms,
                )
            writes = [
                Write("create", new_row(action)),
                # Also for a queued action: its write and the write that frees the slot must conflict.
                control.write_slot(device.id, control.action if before else action.id, device.pairing),
            ]
            if before:
                writes.append(control.write_queue(device.id, control.queue.with_last(action.id)))
            elif lease is not None and lease is not control.lease:
                writes.append(control.write_lease(device.id, lease))
                writes += lease_change(
                    device.id, control.lease, lease, caller=caller, now_ms=now_ms, owner=device.owner
                )
            if action.idempotency_key:
                data = {"action": action.id, "request": request.fingerprint()}
                writes.append(Write("create", Row(device.id, action.idempotency_key, data)))
            rows = await self._tables.batch(records.CONTROL, writes)
            return StoredAction(action, rows[0]), True

        return await records.retry(attempt)

    async def _existing(self, device: Device, request: ActionRequest, key: str) -> StoredAction | None:
        """The action that an earlier request with the same idempotency key started."""
        row = await self._tables.get(records.CONTROL, device.id, key)
        if row is None:
            return None
        if row.data["request"] != request.fingerprint():
            detail = "This Idempotency-Key was used with another request. Use a new key for a new request."
            raise Problem("idempotency-key-reused", 422, "The key was used before", detail)
        return await self._action_store.get(row.data["action"])


def _pinned(movement: RunMovement) -> dict[str, Any]:
    return {name: getattr(movement, name) for name in PINNED}


def device_busy(action: str) -> Problem:
    """The rejection that names the running action."""
    detail = f"The device is running action {action}. Wait for its end or cancel it."
    return Problem("device-busy", 409, "The device is busy", detail, extras={"action": action})


def _lease(  # noqa: PLR0917 (the inputs of one decision)
    caller: Identity, control: ControlRows, draft: Action, request: ActionRequest, before: str, now_ms: int
) -> Lease | None:
    """The lease of the action; ``None``: it is queued behind ``before`` and gets a lease when it starts.

    An action may queue behind another action's own lease, but not behind a lease that a person holds.
    Raises ``device-busy``, ``lease-lost`` or ``lease-held``.
    """
    queued = bool(before) and request.policy == "queue"
    if queued and request.epoch is None:
        current = control.lease
        if current is not None and current.held_by_other(caller, now_ms) and not current.action:
            raise rules.lease_held(current)
        return None
    lease = action_lease(
        control.lease,
        caller,
        epoch=request.epoch,
        action=draft.id,
        lease_ms=request.timeout_ms,
        now_ms=now_ms,
        pairing=draft.pairing,
    )
    if before and not queued:
        raise device_busy(before)
    return lease


def _key(caller: Identity, device: Device, idempotency_key: str) -> str:
    """Row key of an idempotency key, which is valid for one account and one pairing of the device."""
    if not idempotency_key:
        return ""
    return "once:" + hashlib.sha256(f"{caller.account}\n{device.pairing}\n{idempotency_key}".encode()).hexdigest()
