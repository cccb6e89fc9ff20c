"""Advances the queue of each device when its slot is free.

The next action starts or ends; it does not wait for a lease. An action with an epoch requires that its lease is still
held. An action without an epoch gets its own lease, and fails if another session holds one, because motion must not
start when a person releases control.
"""

import logging
from collections.abc import Callable, Collection, Sequence
from typing import Final

from function_app.domain.actions.action import RETRY_MS, Action, Status, end, give_turn, may_reissue, reissue
from function_app.domain.actions.queue import DROPPED, ActionQueue
from function_app.domain.common.ids import split_command
from function_app.domain.common.problems import Problem
from function_app.domain.control import lease as rules
from function_app.domain.control.lease import Lease
from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Identity
from function_app.ports.clock import Clock
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.tables import Row, Tables, Write
from function_app.services.actions.action_store import ActionStore, StoredAction
from function_app.services.actions.dispatcher import ActionDispatcher, MovementUnavailable, PermissionEnded
from function_app.services.actions.trial_log import TrialLog
from function_app.services.control.control_events import ControlEvents, lease_change
from function_app.services.devices.control_rows import apply_device_epochs, read_control, read_control_rows
from function_app.services.storage import records
from function_app.services.storage.reminders import Reminders

CHECK_MS: Final = 2_000
"""Interval of queue checks, in case a process was killed after it freed the slot."""
REMINDER: Final = "queue"
"""Kind of the reminders to check a queue."""
TIMEOUT: Final = "It was queued longer than queue_ms. Start it again, with a larger queue_ms if needed."

_log = logging.getLogger(__name__)


class ActionQueues:
    """Processes the queues of devices."""

    def __init__(
        self,
        *,
        tables: Tables,
        action_store: ActionStore,
        reminders: Reminders,
        dispatcher: ActionDispatcher,
        control_events: ControlEvents,
        trial_log: TrialLog,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._action_store = action_store
        self._reminders = reminders
        self._dispatcher = dispatcher
        self._control_events = control_events
        self._trial_log = trial_log
        self._clock = clock

    async def change(
        self, action: str, change: Callable[[Action], Action], *, existing: StoredAction | None = None
    ) -> StoredAction | None:
        """Like ``ActionStore.change``; then record the end of a trial, and advance the queue. Raises ``busy``."""
        stored = await self._action_store.change(action, change, existing=existing)
        if stored is not None and (stored.action.status.terminal or stored.action.status is Status.UNKNOWN):
            await self._trial_log.record(stored.action)
        if stored is not None and stored.waited_for:
            await self.advance(stored.action.device)
        return stored

    async def reissue(self, action: str, device_epoch: int) -> bool:
        """Issue the command of an action once more, which the device rejected because of its epoch.

        The tables were restored from a backup and are behind the device. The action gets a lease with a higher epoch
        than the device has seen, so it runs. Its id is the same: a device runs a rejected command at most once.

        Args:
            action: Id of a command.
            device_epoch: Highest epoch of the device, which the rejection names.

        Returns:
            Whether the command was issued, by this call or another process. Otherwise the rejection is final: the
            request named an epoch, the cloud has granted a newer lease, the device has ended the lease, or the
            command was issued again before.
        """
        issued = await records.retry(lambda: self._issue_again(action, device_epoch))
        if isinstance(issued, bool):
            return issued
        _log.warning("action %s: the device has epoch %d; issued again with a higher epoch", action, device_epoch)
        await self._send(*issued)
        return True

    async def _issue_again(self, action_id: str, device_epoch: int) -> tuple[StoredAction, Device] | bool:
        device_id, _ = split_command(action_id) or (action_id, "")
        # Read before the action: if another process issues the command meanwhile, the action shows it.
        control = await read_control_rows(self._tables, device_id)
        stored = await self._action_store.get(action_id)
        if stored is None:
            return False
        if not may_reissue(stored.action, device_epoch):
            return stored.action.epoch > device_epoch
        action = stored.action
        try:
            caller, device = await self._dispatcher.current_permissions(action)
        except PermissionEnded:
            return False
        lease = control.lease
        if lease is None or lease.epoch != action.epoch or (lease.action != action_id and device_epoch == lease.epoch):
            return False
        now_ms = self._clock.now_ms()
        await self._reminders.schedule(action_id, now_ms + RETRY_MS)
        higher = rules.acquire(
            rules.catch_up(lease, device_epoch, now_ms=now_ms),
            caller,
            lease_ms=action.timeout_ms,
            now_ms=now_ms,
            pairing=device.pairing,
            action=action_id,
        )
        issued = reissue(action, higher.epoch, now_ms)
        rows = await self._tables.batch(
            records.CONTROL,
            [
                Write("replace", stored.row.changed(records.to_data(issued))),
                control.write_lease(device.id, higher),
                *lease_change(device.id, lease, higher, caller=caller, now_ms=now_ms, owner=device.owner),
            ],
        )
        return StoredAction(issued, rows[0]), device

    async def schedule_check(self, device: str) -> None:
        """Schedule a check of a device's queue; call it before the queue is written."""
        await self._reminders.schedule(f"{REMINDER}:{device}", self._clock.now_ms() + CHECK_MS)

    async def check(self, device: str) -> bool:
        """Advance a device's queue; return whether it is not empty."""
        await self.advance(device)
        return not (await read_control_rows(self._tables, device)).queue.empty

    async def advance(self, device: str) -> None:
        """End dropped actions, and start the next one if the slot is free. Errors are logged; the timer retries."""
        try:
            while await records.retry(lambda: self._step(device)):
                pass
        except (Problem, BusUnavailable) as error:
            _log.warning("queue of %s: %s", device, error)

    async def cancel_all(self, device: str, why: str) -> None:
        """Cancel all queued actions. Raises ``busy``."""
        await self._change_queue(device, lambda queue: queue.with_all_cancelled(why))

    async def cancel(self, device: str, actions: Collection[str], why: str) -> None:
        """Cancel some of the queued actions. Raises ``busy``."""
        await self._change_queue(device, lambda queue: queue.with_cancelled(actions, why))

    async def _change_queue(self, device: str, change: Callable[[ActionQueue], ActionQueue]) -> None:
        async def attempt() -> None:
            control = await read_control_rows(self._tables, device)
            changed = change(control.queue)
            if changed is not control.queue:
                await self._tables.batch(records.CONTROL, [control.write_queue(device, changed)])

        await records.retry(attempt)
        await self.advance(device)

    async def positions(self, actions: Sequence[Action]) -> dict[str, int]:
        """Queue positions of the queued actions of one device; 1 is next."""
        waiting = [action for action in actions if action.status is Status.QUEUED]
        if not waiting:
            return {}
        queue = (await read_control_rows(self._tables, waiting[0].device)).queue
        return {action.id: place for action in waiting if (place := queue.position(action.id)) is not None}

    async def _step(self, device: str) -> bool:
        """Apply one change to the queue; return whether to continue."""
        control = await read_control_rows(self._tables, device)
        queue = control.queue
        if queue.dropped:
            action, why = next(iter(queue.dropped.items()))
            status, message = DROPPED[why]
            await self._drop(device, action, status, why, message)
            return True
        if control.action or not queue.actions:
            return False
        stored = await self._action_store.get(queue.actions[0])
        if stored is None or stored.action.status is not Status.QUEUED:
            await self._tables.batch(records.CONTROL, [control.write_queue(device, queue.without(queue.actions[0]))])
            return True
        return await self._start_next(stored)

    async def _drop(self, device: str, action: str, status: Status, code: str, message: str) -> None:
        """End a dropped action, which also removes it from the queue."""
        now_ms = self._clock.now_ms()
        await self._action_store.change(action, lambda existing: _if_queued(existing, status, code, message, now_ms))
        control = await read_control_rows(self._tables, device)
        if control.queue.contains(action):
            await self._tables.batch(records.CONTROL, [control.write_queue(device, control.queue.without(action))])

    async def _start_next(self, stored: StoredAction) -> bool:
        """Start the first action, or end it if it cannot start."""
        action = stored.action
        now_ms = self._clock.now_ms()
        if now_ms >= action.queued_until_ms:
            await self._refuse(stored, Status.EXPIRED, "queue-timeout", TIMEOUT)
            return True
        try:
            caller, device = await self._dispatcher.current_permissions(action)
        except PermissionEnded as ended:
            status, message = DROPPED[ended.why]
            await self._refuse(stored, status, ended.why, message)
            return True
        try:
            started = await self._start(stored, device, caller)
        except Problem as problem:
            if problem.code not in {"lease-held", "lease-lost"}:
                raise
            await self._refuse(stored, Status.FAILED, problem.code, problem.detail)
            await self._control_events.record_rejection(device, caller, "start a queued action", problem)
            return True
        if started is not None:
            await self._send(started, device)
        return False

    async def _send(self, stored: StoredAction, device: Device) -> None:
        """Publish the command of an action. Errors are logged; the timer retries or ends the action."""
        try:
            await self._dispatcher.send(stored, device)
        except MovementUnavailable:
            _log.warning("action %s: its script was deleted; the timer ends it", stored.action.id)
        except PermissionEnded as ended:
            _log.warning("action %s: %s; the timer ends it", stored.action.id, ended.why)
        except BusUnavailable as error:
            _log.warning("action %s: %s; the timer publishes it", stored.action.id, error)

    async def _start(self, stored: StoredAction, device: Device, caller: Identity) -> StoredAction | None:
        """Write slot, lease, queue and action in one batch; ``None``: another process was first."""
        await self._reminders.schedule(stored.action.id, self._clock.now_ms() + RETRY_MS)
        control = await read_control(self._tables, device)
        if control.action or control.queue.position(stored.action.id) != 1:
            return None
        now_ms = self._clock.now_ms()
        control = apply_device_epochs(control, caller, now_ms)
        lease = action_lease(
            control.lease,
            caller,
            epoch=stored.action.epoch or None,
            action=stored.action.id,
            lease_ms=stored.action.timeout_ms,
            now_ms=now_ms,
            pairing=device.pairing,
        )
        started = give_turn(stored.action, lease.epoch, now_ms)
        writes = [
            Write("replace", stored.row.changed(records.to_data(started))),
            control.write_slot(device.id, started.id, device.pairing),
            control.write_queue(device.id, control.queue.without(started.id)),
        ]
        if lease is not control.lease:
            writes.append(control.write_lease(device.id, lease))
            writes += lease_change(device.id, control.lease, lease, caller=caller, now_ms=now_ms, owner=device.owner)
        rows: tuple[Row, ...] = await self._tables.batch(records.CONTROL, writes)
        return StoredAction(started, rows[0])

    async def _refuse(self, stored: StoredAction, status: Status, code: str, message: str) -> None:
        now_ms = self._clock.now_ms()
        await self._action_store.change(
            stored.action.id, lambda existing: _if_queued(existing, status, code, message, now_ms), existing=stored
        )


def action_lease(
    lease: Lease | None, caller: Identity, *, epoch: int | None, action: str, lease_ms: int, now_ms: int, pairing: str
) -> Lease:
    """The lease of an action: the caller's own, or one for the duration of the action.

    Raises ``lease-lost`` or ``lease-held``.
    """
    if epoch is not None:
        return rules.require_held(lease, caller, epoch=epoch, now_ms=now_ms)
    if lease is not None and lease.is_live(now_ms) and lease.held_by(caller):
        return lease
    return rules.acquire(lease, caller, lease_ms=lease_ms, now_ms=now_ms, pairing=pairing, action=action)


def _if_queued(action: Action, status: Status, code: str, message: str, now_ms: int) -> Action:
    """The ended action, unless it has left the queue."""
    return end(action, status, code, message, now_ms) if action.status is Status.QUEUED else action
