"""Stores actions. Ending an action also frees its slot, lease and place in the queue."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from function_app.domain.actions.action import Action, Status
from function_app.domain.actions.queue import FAILED_BEFORE, UNKNOWN_BEFORE
from function_app.domain.common.ids import split_command
from function_app.domain.control.lease import release
from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Identity
from function_app.ports.monitoring import Histogram, Metrics
from function_app.ports.tables import Row, Tables, Write
from function_app.services.control.control_events import lease_change
from function_app.services.devices.control_rows import ControlRows, read_control_rows
from function_app.services.storage import records

_PREFIX = "action:"
_END = "action;"
_CANCELS_QUEUE = {Status.FAILED: FAILED_BEFORE, Status.UNKNOWN: UNKNOWN_BEFORE}
"""Status of the action in the slot → why the queued actions are cancelled."""


@dataclass(frozen=True, slots=True)
class StoredAction:
    """An action and its row; ``waited_for``: the change ended it and other actions are queued."""

    action: Action
    row: Row
    waited_for: bool = False


def row_location(action: str) -> tuple[str, str] | None:
    """Partition and key of an action, or ``None`` for an invalid id."""
    parts = split_command(action)
    return None if parts is None else (parts[0], f"{_PREFIX}{parts[1]}")


def new_row(action: Action) -> Row:
    """The row of a new action."""
    device, key = row_location(action.id) or (action.device, "")
    return Row(device, key, records.to_data(action))


class ActionStore:
    """Reads and changes actions."""

    def __init__(self, *, tables: Tables, metrics: Metrics) -> None:
        self._tables = tables
        self._metrics = metrics

    async def get(self, action: str) -> StoredAction | None:
        """One action."""
        where = row_location(action)
        if where is None:
            return None
        row = await self._tables.get(records.CONTROL, *where)
        return None if row is None else StoredAction(records.read(row, Action), row)

    async def list(self, device: Device, *, cursor: str | None, limit: int) -> tuple[Sequence[Action], str | None]:
        """Actions of a device since its pairing, newest first. Raises ``cursor-invalid``."""
        page = await records.page(
            self._tables, records.CONTROL, device.id, first=_PREFIX, last=_END, limit=limit, cursor=cursor
        )
        actions = [action for row in page.rows if (action := records.read(row, Action)).pairing == device.pairing]
        # All further rows are older than the pairing, so the list ends here.
        return actions, page.cursor if len(actions) == len(page.rows) else None

    async def change(
        self, action: str, change: Callable[[Action], Action], *, existing: StoredAction | None = None
    ) -> StoredAction | None:
        """Change an action by ETag.

        If it ends or its outcome is unknown, its slot, lease and place in the queue are freed in the same batch.

        If the result is ``waited_for``, the caller must advance the queue; ``ActionQueues.change`` does both.
        ``change`` returns the same object for no change, and may be called several times. ``existing`` saves a read
        unless outdated. Returns ``None`` if the action does not exist. Raises ``busy``.
        """
        stale = False

        async def attempt() -> StoredAction | None:
            nonlocal stale
            stored = await self.get(action) if existing is None or stale else existing
            stale = True
            if stored is None:
                return None
            changed = change(stored.action)
            if changed is stored.action:
                return stored
            writes = [Write("replace", stored.row.changed(records.to_data(changed)))]
            waited_for = False
            if changed.status.terminal or changed.status is Status.UNKNOWN:
                control = await read_control_rows(self._tables, changed.device)
                writes += _freed(changed, control)
                waited_for = not control.queue.without(action).empty
            rows = await self._tables.batch(records.CONTROL, writes)
            if changed.status.terminal and not stored.action.status.terminal:
                duration_s = (changed.ended_ms - changed.created_ms) / 1000
                self._metrics.observe(Histogram.ACTIONS, duration_s, changed.status)
            return StoredAction(changed, rows[0], waited_for)

        return await records.retry(attempt)


def _freed(action: Action, control: ControlRows) -> list[Write]:
    """The writes that free slot, queue place and own lease of an action."""
    writes = []
    queue = control.queue.without(action.id)
    if control.action == action.id:
        writes.append(control.write_slot(action.device, "", action.pairing))
        if (why := _CANCELS_QUEUE.get(action.status)) is not None:
            queue = queue.with_all_cancelled(why)
    if queue != control.queue:
        writes.append(control.write_queue(action.device, queue))
    if control.lease is not None and control.lease.action == action.id:
        free = release(control.lease, now_ms=action.ended_ms)
        writes.append(control.write_lease(action.device, free))
        caller = Identity(action.account, action.caller, action.session)
        writes += lease_change(action.device, control.lease, free, caller=caller, now_ms=action.ended_ms)
    return writes
