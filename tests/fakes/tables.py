"""Tables in memory."""

import asyncio
import bisect
import secrets
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from function_app.adapters.shared import row_codec
from function_app.ports.tables import Conflict, Page, Row, Write


@dataclass
class _Partition:
    rows: dict[str, tuple[str, bytes]] = field(default_factory=dict)
    keys: list[str] = field(default_factory=list)


class MemoryTables:
    """``Tables`` in memory. ``shared`` opens another instance over the rows of the first."""

    def __init__(self, shared: "MemoryTables | None" = None) -> None:
        self._partitions: dict[tuple[str, str], _Partition] = {} if shared is None else shared._partitions

    async def get(self, table: str, partition: str, key: str) -> Row | None:
        await asyncio.sleep(0)
        row = self.partition(table, partition).rows.get(key)
        return None if row is None else row_codec.decode(partition, key, row[1], row[0])

    async def create(self, table: str, row: Row) -> Row:
        return (await self._apply(table, [Write("create", row)]))[0]

    async def replace(self, table: str, row: Row) -> Row:
        return (await self._apply(table, [Write("replace", row)]))[0]

    async def delete(self, table: str, row: Row) -> None:
        await self._apply(table, [Write("delete", row)])

    async def query(
        self,
        table: str,
        partition: str,
        *,
        first: str = "",
        last: str | None = None,
        limit: int = 100,
        cursor: str | None = None,
    ) -> Page:
        row_codec.check_limit(limit)
        await asyncio.sleep(0)
        existing = self.partition(table, partition)
        start = first if cursor is None else max(first, row_codec.read_cursor(cursor))
        begin = bisect.bisect_left(existing.keys, start)
        end = len(existing.keys) if last is None else bisect.bisect_left(existing.keys, last)
        stored = [(key, *existing.rows[key]) for key in existing.keys[begin : min(end, begin + limit)]]
        rows = tuple(row_codec.decode(partition, key, text, etag) for key, etag, text in stored)
        following = begin + limit
        return Page(rows, row_codec.write_cursor(existing.keys[following]) if following < end else None)

    async def batch(self, table: str, writes: Sequence[Write]) -> tuple[Row, ...]:
        return await self._apply(table, writes)

    async def _apply(self, table: str, writes: Sequence[Write]) -> tuple[Row, ...]:
        await asyncio.sleep(0)
        texts = row_codec.check_batch(writes)
        partition = self.partition(table, writes[0].row.partition)
        for write in writes:
            assert write.kind in {"create", "replace", "delete"}
            current = partition.rows.get(write.row.key)
            if write.kind == "create" and current is not None:
                raise Conflict(f"{table}: '{write.row.key}' exists")
            if write.kind != "create" and (current is None or current[0] != write.row.etag):
                raise Conflict(f"{table}: '{write.row.key}' was changed or deleted")
        return tuple(self._write(partition, write, text) for write, text in zip(writes, texts, strict=True))

    def rows(self, *tables: str) -> list[tuple[str, Row]]:
        """Every row with its table, or those of the given tables."""
        return [
            (table, row_codec.decode(partition, key, text, etag))
            for (table, partition), stored in sorted(self._partitions.items())
            if not tables or table in tables
            for key, (etag, text) in sorted(stored.rows.items())
        ]

    def drop(self, table: str) -> None:
        """Remove every row of a table."""
        for stored in [stored for stored in self._partitions if stored[0] == table]:
            del self._partitions[stored]

    async def check(self, *, thorough: bool = False) -> tuple[str, ...]:
        del thorough
        return ()

    def left_bytes(self) -> int | None:
        return None

    async def close(self) -> None:
        """Nothing is open."""

    def partition(self, table: str, partition: str) -> _Partition:
        """The rows of one partition; tests may change them."""
        return self._partitions.setdefault((table, partition), _Partition())

    def _write(self, partition: _Partition, write: Write, text: bytes) -> Row:
        key = write.row.key
        if write.kind == "delete":
            del partition.rows[key]
            partition.keys.pop(bisect.bisect_left(partition.keys, key))
            return write.row
        if write.kind == "create":
            bisect.insort(partition.keys, key)
        etag = secrets.token_hex(8)
        partition.rows[key] = (etag, text)
        return replace(write.row, etag=etag)
