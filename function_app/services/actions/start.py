"""Starting an action: decide in one batch, publish, and wait as long as the caller likes."""

import hashlib
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager, AsyncExitStack, nullcontext
from dataclasses import dataclass, field
from typing import Any, Literal

import msgspec
from msgspec import Struct

from device_agent.protocol import Ack, CollectData, Id, RunMovement, Task
from function_app.domain.actions.action import RETRY_MS, Action, Status, end, reached
from function_app.domain.actions.queue import DROPPED, KEY_ENDED, UNSHARED
from function_app.domain.common.ids import command_id
from function_app.domain.common.problems import Problem, busy_store, invalid
from function_app.domain.control import lease as rules
from function_app.domain.control.lease import Lease
from function_app.domain.devices.devices import Device, Link
from function_app.domain.identity.accounts import Identity
from function_app.ports.clock import Clock
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.tables import Row, Tables, Write
from function_app.services.actions import capability_check
from function_app.services.actions.acks import ActionAcks
from function_app.services.actions.action_store import ActionStore, StoredAction, new_row
from function_app.services.actions.queue import ActionQueues, action_lease
from function_app.services.control.control_events import ControlEvents, lease_change
from function_app.services.devices.control_rows import ControlRows, apply_ended_epoch, read_control
from function_app.services.devices.device_access import DeviceAccess, require_online, require_operator
from function_app.services.messaging.command_sender import CommandSender
from function_app.services.messaging.delivery import Delivery, SignedCommand
from function_app.services.robot_types import parameter_schema as parameters
from function_app.services.robot_types.movements import Movements
from function_app.services.storage import records
from function_app.services.storage.reminders import Reminders

ABANDON_MS = 30_000
"""A start that has not been written after this time is given up: the timer may already have forgotten its note."""


PINNED = ("robot_type", "version", "sha256", "author", "key", "signature")
"""What an action keeps of its movement, so that a command that is sent again is the same one."""


class AskMovement(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="run_movement"):
    """Run a movement of the device's robot type, in its newest version."""

    name: Id
    parameters: dict[str, Any] = {}


Asked = AskMovement | Task


@dataclass(frozen=True, slots=True)
class Start:
    """What to start.

    Attributes:
        epoch: Of the lease that the caller holds; ``None`` asks for one for the time of this action.
        policy: Whether it is refused while the device is busy, or waits for its turn,
        queue_ms: at most so long. ``ttl_ms`` and ``timeout_ms`` count from its turn.
        once: The caller's idempotency key, or empty.
    """

    asked: Asked
    epoch: int | None = None
    policy: Literal["reject", "queue"] = "reject"
    queue_ms: int = 300_000
    ttl_ms: int = 10_000
    timeout_ms: int = 300_000
    wait_ms: int = 0
    wait_for: Literal["started", "done"] = "started"
    once: str = ""

    def fingerprint(self) -> str:
        """The same for the same request."""
        body = msgspec.json.encode(
            [
                self.asked,
                self.epoch,
                self.ttl_ms,
                self.timeout_ms,
                self.wait_ms,
                self.wait_for,
                *((self.policy, self.queue_ms) if self.policy == "queue" else ()),
            ],
            order="deterministic",
        )
        return hashlib.sha256(body).hexdigest()


@dataclass(slots=True)
class _Plan:
    """An action on its way into the tables."""

    device: Device
    action: str
    created_ms: int
    request: dict[str, Any]
    command: RunMovement | Task
    pinned: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Begun:
    """An action that is written, and its acks from before it was sent."""

    found: StoredAction
    acks: AsyncIterator[Ack] | None
    published: bool = False
    undelivered: bool = False


class StartAction:
    """One run of something on one device."""

    def __init__(
        self,
        *,
        tables: Tables,
        devices: DeviceAccess,
        movements: Movements,
        command_sender: CommandSender,
        action_store: ActionStore,
        acks: ActionAcks,
        reminders: Reminders,
        queues: ActionQueues,
        delivery: Delivery,
        control_events: ControlEvents,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._devices = devices
        self._movements = movements
        self._command_sender = command_sender
        self._action_store = action_store
        self._acks = acks
        self._reminders = reminders
        self._queues = queues
        self._delivery = delivery
        self._control_events = control_events
        self._clock = clock

    async def start(
        self, caller: Identity, device_id: str, start: Start, *, gate: AbstractAsyncContextManager[object] | None = None
    ) -> tuple[Action, bool]:
        """Start it; and whether the wanted status (or an end) was reached in time.

        A stop of this process after any write leaves an action that the timer publishes or ends.

        Args:
            caller: Who asks.
            device_id: On which device.
            start: What to start.
            gate: Held while it is written and sent, not while its start is waited for.

        Raises:
            Problem: ``device-unknown``, ``forbidden``, ``movement-unknown``, ``device-offline``, ``device-busy``,
                ``queue-full``, ``lease-held``, ``lease-lost``, ``idempotency-key-reused``, ``busy``,
                ``parameters-invalid``, ``unable``, ``invalid``.
        """
        wanted = Status(start.wait_for)
        async with AsyncExitStack() as listening:
            async with gate or nullcontext():
                begun = await self._begin(caller, device_id, start, listening)
            if begun.undelivered:
                return begun.found.action, False
            action = await self._acks.follow(
                begun.found, begun.acks, wanted=wanted, wait_ms=start.wait_ms, published=begun.published
            )
        return action, reached(action, wanted)

    async def _begin(self, caller: Identity, device_id: str, start: Start, listening: AsyncExitStack) -> "_Begun":
        if isinstance(start.asked, AskMovement):
            parameters.check(start.asked.parameters)
        device, link = await self._devices.get_with_link(caller, device_id)
        async with self._control_events.recording_rejections(device, caller, "start an action"):
            return await self._at(caller, device, link, start, listening)

    async def _at(
        self, caller: Identity, device: Device, link: Link | None, start: Start, listening: AsyncExitStack
    ) -> "_Begun":
        require_operator(device)
        earlier = await self._earlier(caller, device, start)
        if earlier is not None:
            return await self._join(earlier, device, listening)
        require_online(link, self._clock.now_ms())
        plan = await self._plan(caller, device, start)
        ttl_ms = min(start.ttl_ms, start.timeout_ms)
        await self._reminders.schedule(plan.action, plan.created_ms + RETRY_MS)
        if start.policy == "queue":
            await self._queues.schedule_check(device.id)
        stored, created = await self._write(caller, plan, start, ttl_ms)
        if created and stored.action.status is Status.QUEUED:
            await self._queues.advance(device.id)
        if not created or stored.action.status is Status.QUEUED:
            return await self._join(stored, device, listening)
        await self._require_still(caller, device, stored)
        signed = await self._signed(plan, stored.action)
        acks = await listening.enter_async_context(self._delivery.acks(device, plan.action))
        try:
            await self._command_sender.publish(device, signed)
        except BusUnavailable:
            # It is written: the timer publishes it as soon as the broker is back, or ends it.
            return _Begun(stored, acks, undelivered=True)
        return _Begun(stored, acks, published=True)

    async def _require_still(self, caller: Identity, device: Device, stored: StoredAction) -> None:
        """End an action of somebody with whom the device was un-shared, or whose key was ended, while it was written.

        Raises:
            Problem: ``device-unknown``, ``forbidden``.
        """
        try:
            await self._devices.require_still_allowed(caller, device)
        except Problem:
            why = KEY_ENDED if caller.key else UNSHARED
            status, message = DROPPED[why]
            now_ms = self._clock.now_ms()
            await self._queues.change(
                stored.action.id, lambda existing: end(existing, status, why, message, now_ms), existing=stored
            )
            raise

    async def _join(self, stored: StoredAction, device: Device, listening: AsyncExitStack) -> "_Begun":
        """Where nothing is to be sent: an earlier request started it, or it waits for its turn."""
        acks = await listening.enter_async_context(self._delivery.acks(device, stored.action.id))
        return _Begun(await self._action_store.get(stored.action.id) or stored, acks)

    async def _plan(self, caller: Identity, device: Device, start: Start) -> _Plan:
        asked, now_ms = start.asked, self._clock.now_ms()
        request: dict[str, Any] = msgspec.to_builtins(asked)
        action = command_id(device.id, now_ms)
        if isinstance(asked, Task):
            if isinstance(asked, CollectData) and asked.duration_s * 1000 > start.timeout_ms:
                raise invalid("A gathering cannot last longer than the action: raise timeout_ms, or lower duration_s.")
            await capability_check.check(self._tables, device, asked)
            plan = _Plan(device, action, now_ms, request, asked)
        else:
            # Whoever starts it: on a device run the movements that its owner has for it, and no others.
            owner = Identity(device.owner, "", "")
            movement, source = await self._movements.get(owner, device.robot_type, asked.name)
            command = RunMovement(
                robot_type=device.robot_type,
                name=movement.name,
                version=movement.version,
                sha256=movement.sha256,
                source=source,
                parameters=parameters.fit(movement.parameters_schema, asked.parameters),
                author=movement.author or device.owner,
                key=movement.key,
                signature=movement.signature,
                timeout_ms=start.timeout_ms,
            )
            # With the defaults: a command that is sent again must be the same one.
            request["parameters"] = command.parameters
            pinned = {name: getattr(command, name) for name in PINNED}
            plan = _Plan(device, action, now_ms, request, command, pinned)
        # Before anything is written: what cannot be sent must not take the slot.
        self._command_sender.validate(device, action, plan.command, caller=caller.name, ttl_ms=1)
        return plan

    async def _signed(self, plan: _Plan, action: Action) -> SignedCommand:
        return await self._command_sender.sign(
            plan.device,
            action.id,
            plan.command,
            caller=action.who,
            epoch=action.epoch,
            issued_ms=action.created_ms,
            ttl_ms=action.ttl_ms,
        )

    async def _write(self, caller: Identity, plan: _Plan, start: Start, ttl_ms: int) -> tuple[StoredAction, bool]:
        """Action, slot, lease and idempotency row in one batch; not fresh: another request with the key was first."""

        async def attempt() -> tuple[StoredAction, bool]:
            now_ms = self._clock.now_ms()
            control = await read_control(self._tables, plan.device)
            control = await apply_ended_epoch(self._tables, plan.device, control, caller, now_ms)
            if now_ms - plan.created_ms > ABANDON_MS:
                raise busy_store()
            earlier = await self._earlier(caller, plan.device, start)
            if earlier is not None:
                return earlier, False
            before = control.action or next(iter((*control.queue.actions, *control.queue.dropped)), "")
            lease = _lease(caller, control, plan, start, before, now_ms)
            waits = bool(before)
            action = Action(
                id=plan.action,
                device=plan.device.id,
                account=caller.account,
                who=caller.name,
                pairing=plan.device.pairing,
                request=plan.request,
                epoch=lease.epoch if lease is not None else 0,
                created_ms=plan.created_ms,
                ttl_ms=ttl_ms,
                deadline_ms=plan.created_ms + start.timeout_ms + (start.queue_ms if waits else 0),
                status=Status.QUEUED if waits else Status.CREATED,
                pinned=plan.pinned,
                once=_once_key(caller, plan.device, start) if start.once else "",
                session=caller.session,
                timeout_ms=start.timeout_ms,
                queued_until_ms=plan.created_ms + start.queue_ms if waits else 0,
            )
            writes = [
                Write("create", new_row(action)),
                # Also where it waits: whoever frees the slot now must see the queue, or this must see the slot free.
                control.write_slot(plan.device.id, control.action if waits else plan.action, plan.device.pairing),
            ]
            if waits:
                writes.append(control.write_queue(plan.device.id, control.queue.with_last(plan.action)))
            elif lease is not None and lease is not control.lease:
                writes.append(control.write_lease(plan.device.id, lease))
                writes += lease_change(
                    plan.device.id, control.lease, lease, caller=caller, now_ms=now_ms, owner=plan.device.owner
                )
            if start.once:
                data = {"action": plan.action, "request": start.fingerprint()}
                writes.append(Write("create", Row(plan.device.id, action.once, data)))
            rows = await self._tables.batch(records.CONTROL, writes)
            return StoredAction(action, rows[0]), True

        return await records.retry(attempt)

    async def _earlier(self, caller: Identity, device: Device, start: Start) -> StoredAction | None:
        """The action that an earlier request with the same idempotency key started."""
        if not start.once:
            return None
        row = await self._tables.get(records.CONTROL, device.id, _once_key(caller, device, start))
        if row is None:
            return None
        if row.data["request"] != start.fingerprint():
            detail = "This Idempotency-Key was used with another request. Use a new key for a new request."
            raise Problem("idempotency-key-reused", 422, "The key was used before", detail)
        return await self._action_store.get(row.data["action"])


def device_busy(action: str) -> Problem:
    """The refusal that names the running action."""
    detail = f"The device is running action {action}. Wait for its end or cancel it."
    return Problem("device-busy", 409, "The device is busy", detail, extras={"action": action})


def _lease(  # noqa: PLR0917 (what decides)
    caller: Identity, control: ControlRows, plan: _Plan, start: Start, before: str, now_ms: int
) -> Lease | None:
    """The lease it runs under; ``None`` where it waits behind ``before`` without one, and gets its own at its turn.

    One that waits may wait for the end of an action that has the lease for its own time, not for a person who took it.

    Raises:
        Problem: ``device-busy``, ``lease-lost``, ``lease-held``.
    """
    waits = bool(before) and start.policy == "queue"
    if waits and start.epoch is None:
        held = control.lease
        if held is not None and held.is_live(now_ms) and not held.held_by(caller) and not held.action:
            raise rules.lease_held(held)
        return None
    lease = action_lease(
        control.lease,
        caller,
        epoch=start.epoch,
        action=plan.action,
        lease_ms=start.timeout_ms,
        now_ms=now_ms,
        pairing=plan.device.pairing,
    )
    if before and not waits:
        raise device_busy(before)
    return lease


def _once_key(caller: Identity, device: Device, start: Start) -> str:
    """Of one account and one pairing: the actions of an earlier pairing are nobody's any more."""
    return "once:" + hashlib.sha256(f"{caller.account}\n{device.pairing}\n{start.once}".encode()).hexdigest()
