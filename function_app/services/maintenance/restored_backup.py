"""Settles what was in progress when a backup was made, after it was restored."""

from dataclasses import replace
from typing import Final

from function_app.domain.actions.action import Action, Status
from function_app.domain.actions.queue import RESTORED
from function_app.domain.audit.hash_chain import CLOUD, AccountEvent
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.actions.action_store import ActionStore
from function_app.services.actions.queue import ActionQueues
from function_app.services.audit.audit_log import AuditLog
from function_app.services.audit.audit_reader import AuditReader
from function_app.services.storage import records
from function_app.services.storage.reminders import SHARDS, Reminders

RESEND: Final = "resend"
"""Kind of the reminders to send the command of an open action again: its device answers with its last ack."""
RESEND_MS: Final = 5_000
"""Interval of these reminders, until the action ends."""
_ANSWER_MS: Final = 60_000
"""Time in which devices can report how an action has ended."""


class RestoredBackup:
    """Prepares restored tables before the server uses them. No motion starts because of a restore."""

    def __init__(
        self,
        *,
        tables: Tables,
        action_store: ActionStore,
        queues: ActionQueues,
        reminders: Reminders,
        audit_log: AuditLog,
        audit_reader: AuditReader,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._action_store = action_store
        self._queues = queues
        self._reminders = reminders
        self._audit_log = audit_log
        self._audit_reader = audit_reader
        self._clock = clock

    async def settle(self, *, created_ms: int) -> int:
        """Cancel queued actions, ask devices for the end of started ones, and record the restore in the audit log.

        Args:
            created_ms: Time of the backup [ms since 1970].

        Returns:
            The number of open actions.
        """
        for chain in sorted({CLOUD, *await self._audit_reader.chains()}):
            await self._audit_log.record(chain, AccountEvent.RESTORED, None, backup_ms=created_ms)
        actions = await self._open_actions()
        for device in sorted({action.device for action in actions}):
            await self._queues.cancel_all(device, RESTORED)
        now_ms = self._clock.now_ms()
        for action in actions:
            await self._reminders.schedule(f"{RESEND}:{action.id}", now_ms)
            await self._action_store.change(action.id, lambda stored: _awaiting_answer(stored, now_ms))
        return len(actions)

    async def _open_actions(self) -> list[Action]:
        """Each open action has a reminder."""
        names = set()
        for shard in range(SHARDS):
            async for row in records.all_rows(self._tables, records.PENDING, str(shard)):
                names.add(row.key.partition(":")[2])
        stored = [await self._action_store.get(name) for name in sorted(names)]
        return [each.action for each in stored if each is not None and not each.action.status.terminal]


def _awaiting_answer(action: Action, now_ms: int) -> Action:
    """The action, which may have ended at the device since the backup. It does not expire before the device answers."""
    if action.status.terminal:
        return action
    status = action.status if action.status.rank > Status.RECEIVED.rank else Status.RECEIVED
    return replace(action, status=status, deadline_ms=max(action.deadline_ms, now_ms + _ANSWER_MS), reissuable=False)
