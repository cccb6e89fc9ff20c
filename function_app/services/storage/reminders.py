"""Durable timers: reminders by due time, so that no table is scanned.

A reminder is written before the record that it refers to. When it is due and the record needs no action, it is deleted.
"""

import hashlib

from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.storage import records

SHARDS = 8


class Reminders:
    """Stores reminders."""

    def __init__(self, *, tables: Tables) -> None:
        self._tables = tables

    async def schedule(self, action: str, due_ms: int) -> Row | None:
        """Schedule a check of ``action`` at ``due_ms``. Idempotent: the row is returned only by the first call."""
        try:
            return await self._tables.create(records.PENDING, Row(_shard(action), f"{due_ms:013d}:{action}", {}))
        except Conflict:
            return None

    async def due(self, shard: int, now_ms: int, *, limit: int = 100) -> list[tuple[str, Row]]:
        """Due reminders with their rows."""
        page = await self._tables.query(records.PENDING, str(shard), last=f"{now_ms + 1:013d}", limit=limit)
        return [(row.key.partition(":")[2], row) for row in page.rows]

    async def cancel(self, note: Row) -> None:
        """Delete a reminder that was processed."""
        try:
            await self._tables.delete(records.PENDING, note)
        except Conflict:
            return


def _shard(action: str) -> str:
    return str(hashlib.sha256(action.encode()).digest()[0] % SHARDS)
