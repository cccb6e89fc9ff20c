"""Tables of rows with partition, key and ETag: Azure Tables, DynamoDB or SQLite.

Partitions and keys are non-empty Unicode text of at most 512 characters. Adapters encode them so that the keys of a
partition sort by their UTF-8 bytes. ``data`` is a JSON object of at most 256 KB.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, Protocol

MAX_BATCH = 100
"""Maximum number of writes in a batch: the limit of Azure Tables and DynamoDB."""
MAX_BATCH_BYTES = 1_000_000
"""Maximum size of a batch as JSON [bytes]. Azure accepts 4 MiB per request; its SDK escapes up to three bytes for
one, and keys and headers of 100 writes take up to 750 KB. DynamoDB accepts 4 MB."""
MAX_DATA_BYTES = 256 * 1024
SCHEMA = 1
"""Version of the row formats that this server writes. Raise it with every change of a stored record."""
MAX_KEY_LENGTH = 512


RELAXED: Final = frozenset(
    {
        "Attempts",
        "Data",
        "Descriptions",
        "Diagnostics",
        "Events",
        "Faults",
        "Forget",
        "Latency",
        "Mailbox",
        "ModelChecks",
        "Pending",
        "Series",
        "Sessions",
        "Uploads",
        "Usage",
        "Watched",
        "Watchers",
    }
)
"""Tables whose last writes may be lost when the machine loses power: measurements, and what is written again or before
the row that needs it. A store keeps the order of writes: a later durable write makes them durable, too."""
_RELAXED_KEYS: Final = {"Agents": ("link", "state:"), "Control": ("event:", "now:epochs")}
"""Key prefixes of rows that agents report again after each connection, and of events whose deletion is repeated."""


def is_durable(table: str, key: str) -> bool:
    """Whether an acknowledged write of this row must survive a loss of power."""
    return table not in RELAXED and not key.startswith(_RELAXED_KEYS.get(table, ()))


class Conflict(Exception):  # noqa: N818 (an outcome that callers expect, not a fault)
    """The row exists already, does not exist, or has another ETag."""


class StoreError(Exception):
    """The store is not available; the text says what to do."""


class StoreFullError(StoreError):
    """The store has reached its maximum size."""


@dataclass(frozen=True, slots=True)
class Row:
    """One row.

    Attributes:
        etag: Empty until the store assigns one.
        schema: Highest ``SCHEMA`` of the servers that wrote the row; 0: written before rows had a version.
    """

    partition: str
    key: str
    data: Mapping[str, Any] = field(default_factory=dict)
    etag: str = ""
    schema: int = SCHEMA

    def changed(self, data: Mapping[str, Any]) -> "Row":
        """The row with the fields of ``data``. Other fields stay: a newer server may have written them."""
        return Row(self.partition, self.key, {**self.data, **data}, self.etag, self.schema)


@dataclass(frozen=True, slots=True)
class Page:
    """Rows in key order, and the cursor of the next page (``None``: last page)."""

    rows: tuple[Row, ...]
    cursor: str | None


@dataclass(frozen=True, slots=True)
class Write:
    """One change in a batch: ``create`` requires that the row does not exist, the others require ``row.etag``."""

    kind: Literal["create", "replace", "delete"]
    row: Row


class Tables(Protocol):
    """Stores rows. Every call is atomic, and reads see all earlier writes.

    Acknowledged writes of durable rows (``is_durable``) survive a loss of power. Damaged rows are never returned.

    A retried ``create``, ``replace`` or ``delete`` raises ``Conflict`` if the first call succeeded. If the store is not
    reachable, every method raises ``StoreError``; the state of a failed write is unknown.

    Example::

        row = await tables.create("Devices", Row("agent", "arm", {"label": "Arm"}))
        await tables.replace("Devices", row.changed({"label": "Left arm"}))
    """

    async def get(self, table: str, partition: str, key: str) -> Row | None:
        """One row, or ``None``."""

    async def create(self, table: str, row: Row) -> Row:
        """Create a row that does not exist yet.

        Returns:
            The row with its new ETag.

        Raises:
            Conflict: The row exists.
        """

    async def replace(self, table: str, row: Row) -> Row:
        """Replace the row that has ``row.etag``.

        Raises:
            Conflict: The row was deleted or changed since it was read.
        """

    async def delete(self, table: str, row: Row) -> None:
        """Delete the row that has ``row.etag``.

        Raises:
            Conflict: The row was deleted or changed since it was read.
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
        """At most ``limit`` (1…1,000) rows of a partition with ``first`` ≤ key < ``last`` (``None``: to the end)."""

    async def batch(self, table: str, writes: Sequence[Write]) -> tuple[Row, ...]:
        """Apply all writes or none: 1…``MAX_BATCH`` writes in one partition, each key once.

        Returns:
            The rows as written, in order (a deleted row as passed).

        Raises:
            Conflict: One write does not match; nothing was written.
            ValueError: No writes, too many, over ``MAX_BATCH_BYTES``, two partitions, or a repeated key.
        """

    async def check(self, *, thorough: bool = False) -> tuple[str, ...]:
        """Known losses and damage of the stored data, each with its remedy; empty: none.

        ``thorough`` reads everything that is stored on this machine. A cloud store checks its data itself: none.
        """

    def left_bytes(self) -> int | None:
        """How many bytes the store may still grow; ``None``: it has no limit."""

    async def close(self) -> None:
        """Close all connections."""
