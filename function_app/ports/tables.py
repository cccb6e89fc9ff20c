"""Rows in tables: partition and key, optimistic concurrency by ETag. Azure Tables, DynamoDB, SQLite.

Partitions and keys are any non-empty Unicode text up to 512 characters; adapters encode them for their store such that
keys of one partition still sort as their UTF-8 bytes do. ``data`` is a JSON object of at most 256 KB.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

MAX_BATCH = 100
"""Most writes in one batch: Azure Tables' and DynamoDB's limit."""
MAX_BATCH_BYTES = 1_000_000
"""Most data in one batch, as JSON. Azure takes 4 MiB of request; its SDK's escapes make up to three bytes of one, and
keys and headers of 100 writes take up to 750 KB. DynamoDB takes 4 MB."""
MAX_DATA_BYTES = 256 * 1024
MAX_KEY_LENGTH = 512


class Conflict(Exception):  # noqa: N818 (an outcome that callers expect, not a fault)
    """The row is not as the writer believed: it exists already, is gone, or has another ETag."""


class StoreError(Exception):
    """The store cannot be used; its text says what to do."""


@dataclass(frozen=True, slots=True)
class Row:
    """One row. ``etag`` is empty until the store has given one."""

    partition: str
    key: str
    data: Mapping[str, Any] = field(default_factory=dict)
    etag: str = ""


@dataclass(frozen=True, slots=True)
class Page:
    """Rows in key order, and where to go on (``None``: that was all)."""

    rows: tuple[Row, ...]
    cursor: str | None


@dataclass(frozen=True, slots=True)
class Write:
    """One change in a batch: ``create`` wants no such row, ``replace`` and ``delete`` want ``row.etag``."""

    kind: Literal["create", "replace", "delete"]
    row: Row


class Tables(Protocol):
    """A store of tables. Every call is atomic; reads after a write see it."""

    async def get(self, table: str, partition: str, key: str) -> Row | None:
        """One row, or ``None``."""

    async def create(self, table: str, row: Row) -> Row:
        """Write a row that must not exist yet.

        Returns:
            The row with its new ETag.

        Raises:
            Conflict: It exists.
        """

    async def replace(self, table: str, row: Row) -> Row:
        """Write over the row that has ``row.etag``.

        Raises:
            Conflict: It is gone or has changed since it was read.
        """

    async def delete(self, table: str, row: Row) -> None:
        """Delete the row that has ``row.etag``.

        Raises:
            Conflict: It is gone or has changed since it was read.
        """

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
        """Rows of one partition with ``first`` ≤ key < ``last`` (``None``: to the end), at most ``limit`` (1…1,000)."""

    async def batch(self, table: str, writes: Sequence[Write]) -> tuple[Row, ...]:
        """All writes or none; 1…``MAX_BATCH`` of them, one partition, each key once.

        Returns:
            The rows as written, in order (a deleted row as it was given).

        Raises:
            Conflict: One of them does not fit; nothing was written.
            ValueError: Empty, too many, over ``MAX_BATCH_BYTES``, two partitions, or a key twice.
        """

    async def close(self) -> None:
        """Let go of connections."""
