"""Notes about open actions, by the time at which a timer has to look at them: nothing needs to be scanned.

A note is written before its action and outlives it: an action without a note cannot be, a note without an open action
is dropped when it is due.
"""

import hashlib

from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.storage import records

SHARDS = 8


class Reminders:
    """The notes."""

    def __init__(self, *, tables: Tables) -> None:
        self._tables = tables

    async def schedule(self, action: str, due_ms: int) -> Row | None:
        """Look at ``action`` at ``due_ms``. The same note twice is one; whoever writes it second gets no row."""
        try:
            return await self._tables.create(records.PENDING, Row(_shard(action), f"{due_ms:013d}:{action}", {}))
        except Conflict:
            return None

    async def due(self, shard: int, now_ms: int, *, limit: int = 100) -> list[tuple[str, Row]]:
        """Actions whose time has come, with their notes."""
        page = await self._tables.query(records.PENDING, str(shard), last=f"{now_ms + 1:013d}", limit=limit)
        return [(row.key.partition(":")[2], row) for row in page.rows]

    async def cancel(self, note: Row) -> None:
        """Forget a note that was dealt with."""
        try:
            await self._tables.delete(records.PENDING, note)
        except Conflict:
            return


def _shard(action: str) -> str:
    return str(hashlib.sha256(action.encode()).digest()[0] % SHARDS)
