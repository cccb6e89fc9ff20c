"""Durable timers: reminders by due time, so that no table is scanned.

A reminder is written before the record that it refers to. When it is due and the record needs no action, it is deleted.
"""

import hashlib

from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.storage import records

SHARDS = 8
_WRITTEN = "written_ms"


class Reminders:
    """Stores reminders."""

    def __init__(self, *, tables: Tables, clock: Clock) -> None:
        self._tables = tables
        self._clock = clock

    async def schedule(self, action: str, due_ms: int) -> Row | None:
        """Schedule a check of ``action`` at ``due_ms``. Idempotent: the row is returned only by the first call."""
        note = Row(_shard(action), f"{due_ms:013d}:{action}", {_WRITTEN: self._clock.now_ms()})
        try:
            return await self._tables.create(records.PENDING, note)
        except Conflict:
            return None

    async def due(self, shard: int, now_ms: int, *, limit: int = 100) -> list[tuple[str, Row]]:
        """Due reminders with their rows."""
        page = await self._tables.query(records.PENDING, str(shard), last=f"{now_ms + 1:013d}", limit=limit)
        return [(row.key.partition(":")[2], row) for row in page.rows]

    async def repeat_early(self, *, written_after_ms: int) -> None:
        """Schedule a check now for each reminder with a later time of writing: the clock was set back since.

        The reminders themselves stay, because some refer to an absolute time.
        """
        for shard in range(SHARDS):
            async for row in records.all_rows(self._tables, records.PENDING, str(shard)):
                if row.data.get(_WRITTEN, 0) > written_after_ms:
                    await self.schedule(row.key.partition(":")[2], self._clock.now_ms())

    async def cancel(self, note: Row) -> None:
        """Delete a reminder that was processed."""
        try:
            await self._tables.delete(records.PENDING, note)
        except Conflict:
            return


def _shard(action: str) -> str:
    return str(hashlib.sha256(action.encode()).digest()[0] % SHARDS)
