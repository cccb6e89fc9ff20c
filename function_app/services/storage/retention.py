"""Scheduled deletion of rows and blobs.

A deletion is scheduled together with the data and removed last, so it survives a killed process. Rows with a later
``expires_ms`` are kept, because their writer has scheduled another deletion, unless a whole partition is deleted.
"""

import asyncio
import hashlib
import json
import logging
from collections.abc import Sequence
from typing import Any, Final

from function_app.domain.common.problems import Problem
from function_app.ports.blobs import Blobs
from function_app.ports.tables import MAX_BATCH, Conflict, Row, Tables, Write
from function_app.services.storage import quota, records

DAY_MS: Final = 86_400_000
SHARDS = 8
NOTES = 25
"""Scheduled deletions per shard and run."""
ROWS = 500
"""Rows per deletion and run; the next run continues."""
_BATCH_BYTES = 1_000_000
"""Maximum size of the rows deleted in one batch: some stores count deleted data."""

_log = logging.getLogger(__name__)


class Retention:
    """Schedules and executes deletions."""

    def __init__(self, *, tables: Tables, blobs: Blobs) -> None:
        self._tables = tables
        self._blobs = blobs

    async def delete_rows_at(self, table: str, partition: str, *, first: str, last: str | None, due_ms: int) -> None:
        """Delete the rows with ``first`` ≤ key < ``last`` (``None``: all from ``first``) at ``due_ms`` [ms since 1970].

        Rows with a later ``expires_ms`` are kept. Idempotent.
        """
        await self._note({"table": table, "partition": partition, "first": first, "last": last}, due_ms)

    async def delete_partition_at(self, table: str, partition: str, *, due_ms: int) -> None:
        """Delete all rows of a partition, also those with a later ``expires_ms``. Idempotent."""
        await self._note({"table": table, "partition": partition, "first": "", "last": None, "all": True}, due_ms)

    async def delete_row_at(self, table: str, partition: str, key: str, *, due_ms: int) -> None:
        """Delete one row, like ``delete_rows_at``."""
        await self.delete_rows_at(table, partition, first=key, last=key + "\0", due_ms=due_ms)

    async def delete_blob_at(self, name: str, *, due_ms: int, row: tuple[str, str, str] | None = None) -> None:
        """Delete a blob at ``due_ms``, unless the row at ``row`` names it and expires later. Idempotent."""
        await self._note({"blob": name} if row is None else {"blob": name, "row": row}, due_ms)

    async def delete_due(self, now_ms: int) -> None:
        """Execute a part of the due deletions. Idempotent and safe to run concurrently.

        Raises:
            StoreError: The stores are not available.
        """
        await asyncio.gather(*(self._shard(shard, now_ms) for shard in range(SHARDS)))

    async def _note(self, target: dict[str, Any], due_ms: int) -> None:
        digest = hashlib.sha256(json.dumps(target, sort_keys=True).encode()).hexdigest()
        row = Row(str(int(digest[:2], 16) % SHARDS), f"{due_ms:013d}:{digest[:32]}", target)
        try:
            await self._tables.create(records.FORGET, row)
        except Conflict:
            return

    async def _shard(self, shard: int, now_ms: int) -> None:
        due = await self._tables.query(records.FORGET, str(shard), last=f"{now_ms + 1:013d}", limit=NOTES)
        for note in due.rows:
            try:
                if await self._done(note, now_ms):
                    await self._tables.delete(records.FORGET, note)
            except (Conflict, Problem):
                _log.debug("another process executes %s, or a row has changed; retrying in the next run", note.key)

    async def _done(self, note: Row, now_ms: int) -> bool:
        """Delete the target of ``note``; return whether it was deleted completely."""
        target = note.data
        if "blob" in target:
            if "row" in target and await self._is_named(target["blob"], target["row"], now_ms):
                return True
            await self._blobs.delete(target["blob"])
            await quota.release_owned(self._tables, target["blob"])
            return True
        table, partition, last = target["table"], target["partition"], target["last"]
        first, seen = target["first"], 0
        while seen < ROWS:
            page = await self._tables.query(table, partition, first=first, last=last, limit=MAX_BATCH)
            if not page.rows:
                return True
            expired = [row for row in page.rows if "all" in target or row.data.get("expires_ms", 0) <= now_ms]
            for batch in _batches(expired):
                await self._tables.batch(table, batch)
            if page.cursor is None:
                return True
            first, seen = page.rows[-1].key + "\0", seen + len(page.rows)
        await self._tables.replace(records.FORGET, note.changed({"first": first}))
        return False

    async def _is_named(self, blob: str, place: Sequence[str], now_ms: int) -> bool:
        """Whether a row that has not expired names the blob; its writer has scheduled another deletion."""
        row = await self._tables.get(*place)
        return row is not None and row.data.get("expires_ms", 0) > now_ms and blob in row.data.values()


def _batches(rows: list[Row]) -> list[list[Write]]:
    batches: list[list[Write]] = []
    left = 0
    for row in rows:
        size = len(json.dumps(dict(row.data)))
        if not batches or size > left:
            batches.append([])
            left = _BATCH_BYTES
        batches[-1].append(Write("delete", row))
        left -= size
    return batches
