"""Settles what was in progress when a backup was made, after it was restored."""

from collections.abc import Iterable

from function_app.domain.actions.action import NO_REPORT, Action, Status, end
from function_app.domain.actions.queue import RESTORED
from function_app.domain.audit.hash_chain import CLOUD, AccountEvent
from function_app.domain.control.lease import after_restore
from function_app.domain.devices.devices import Agent
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.actions.action_store import ActionStore
from function_app.services.actions.queue import ActionQueues
from function_app.services.audit.audit_log import AuditLog
from function_app.services.audit.audit_reader import AuditReader
from function_app.services.devices.control_rows import read_control_rows
from function_app.services.devices.device_access import devices_of
from function_app.services.storage import records
from function_app.services.storage.reminders import SHARDS, Reminders


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

    async def settle(self, *, created_ms: int, agents: Iterable[str]) -> int:
        """Cancel queued actions, ask devices for the end of started ones, and end all leases.

        Args:
            created_ms: Time of the backup [ms since 1970], which the audit log names.
            agents: Ids of all agents.

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
            await self._reminders.schedule(action.id, now_ms)
            await self._action_store.change(
                action.id, lambda stored: end(stored, Status.UNKNOWN, RESTORED, NO_REPORT, now_ms)
            )
        for agent in agents:
            await self._end_leases(agent)
        return len(actions)

    async def _end_leases(self, agent: str) -> None:
        _, record = await records.find(self._tables, records.AGENTS, agent, "agent", Agent)
        for device in () if record is None else devices_of(record):
            control = await read_control_rows(self._tables, device.id)
            lease = after_restore(control.lease, pairing=device.pairing, now_ms=self._clock.now_ms())
            await self._tables.batch(records.CONTROL, [control.write_lease(device.id, lease)])

    async def _open_actions(self) -> list[Action]:
        """Each open action has a reminder."""
        names = set()
        for shard in range(SHARDS):
            async for row in records.all_rows(self._tables, records.PENDING, str(shard)):
                names.add(row.key.partition(":")[2])
        stored = [await self._action_store.get(name) for name in sorted(names)]
        return [each.action for each in stored if each is not None and not each.action.status.terminal]
