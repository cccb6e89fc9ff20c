"""Names of tables and keys, conversion of records, and optimistic concurrency."""

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from typing import Any, TypeVar

import msgspec

from function_app.domain.common.problems import busy_store, invalid_cursor
from function_app.ports.tables import Conflict, Page, Row, Tables, Write

ACCOUNTS = "Accounts"
"""Partition: account id (or ``name:<name>``, ``open-id:<hash>``); keys ``account``, ``space:<id>``, ``session:<id>``,
``signed-out:<session>``, ``sign-in:<counts down with time>:<session>``, ``password``, ``second-factor``."""
SIGN_INS = "SignIns"
"""Partition: first letter of the token's hash; key: the hash."""
API_KEYS = "ApiKeys"
"""Partition: id of the key; key: ``key``. Index in ``Members``: ``api-key:<id>``."""
AGENTS = "Agents"
"""Partition: agent id; keys ``agent``, ``link``, ``state:<device name>``."""
CLAIMS = "Claims"
"""Partition: first letter of the code; key: the code."""
ATTEMPTS = "Attempts"
"""Partition: account id, ``address:<address>``, ``session:<id>``, ``device:<id>`` (a known browser),
``name:<hash of the name>`` or ``name:<hash>@<address>``; key: kind of secret."""
MEMBERS = "Members"
"""Partition: account id; keys ``agent:<agent id>``, ``share:device:<id>``, ``share:space:<id>``. An index only: the
rows of agents and shares decide."""
SHARES = "Shares"
"""Partition: ``device:<id>`` or ``space:<id>``; key ``account:<account id>``; and, as an index, with ``agent:<id>`` as
well, ``invitation:<id>``."""
INVITATIONS = "Invitations"
"""Partition: first letter of the secret's hash; key: the hash, which is the invitation's id."""
CONTROL = "Control"
"""Partition: device id; keys ``now:lease``, ``now:slot``, ``now:queue``, ``action:<suffix>``, ``once:<hash>``,
``camera-consent``, and ``event:<id>`` for events to publish."""
PENDING = "Pending"
"""Partition: shard; key: ``<due ms>:<what>``, an action's id, ``queue:<device id>``, ``lease:<device id>``,
``leave:<agent id>``, ``share-changed:<on>|<account id>``, ``share-expires:<on>|<account id>``
``transfer:<invitation id>``, ``audit:<account>`` or ``anchor:<account>``."""
ROBOT_TYPES = "RobotTypes"
"""Partition: ``<account>/<robot type>``; keys ``type``, ``version:<number>``. Index in ``Members``: ``type:<type>``."""
MODEL_CHECKS = "ModelChecks"
"""Partitions ``checks`` and ``looks``; keys begin with the time from which they are due [ms]."""
MOVEMENTS = "Movements"
"""Partition: ``<account>/<robot type>``; keys: name, ``~<name>:<counts down with the version>``."""
DESCRIPTIONS = "Descriptions"
"""Partition: agent id; key: device name."""
FAULTS = "Faults"
"""Partition: ``<device>/<pairing>``; see ``services/health/faults.py``."""
DIAGNOSTICS = "Diagnostics"
"""Partition: ``<device>/<pairing>``; key: stream."""
WATCHERS = "Watchers"
"""Partition: device id; key: sign-in session. Current viewers; see ``services/devices/viewers.py``."""
WATCHED = "Watched"
"""Partition: shard; keys ``<due ms>:<agent id>``, ``agent:<agent id>``."""
LATENCY = "Latency"
"""Partition: ``<device>/<pairing>``; see ``services/telemetry/latency.py``."""
DATA = "Data"
"""Partition: shard; key: ``<arrival ms>:<id>``. Received samples that are not yet in their series."""
SERIES = "Series"
"""Partition: ``<device>/<pairing>``, key: stream; and ``<device>/<pairing>/<stream>``, see
``domain/telemetry/series.py``."""
UPLOADS = "Uploads"
"""Partition: ``<device>/<pairing>``; see ``services/telemetry/uploads.py``."""
USAGE = "Usage"
"""Partition: account id; keys: blob name (its size), ``:totals`` (sums); see ``services/storage/quota.py``."""
RECORDINGS = "Recordings"
"""Partition: ``<device>/<pairing>``; keys ``recording:<epoch>``, ``segment:<epoch>:<number>``."""
EVENTS = "Events"
"""Partition: ``<device>/<pairing>``; key: counts down with time, newest first."""
SESSIONS = "Sessions"
"""Partition: ``<device>/<pairing>``; key: counts down with the epoch, newest first."""
TRIALS = "Trials"
"""Partition: ``<device>/<pairing>``, key: last part of the action's id, newest first; and
``batches/<account>/<robot type>``, key ``<task>:<counts down with time>``."""
AUDIT = "Audit"
"""Partition: account id (or ``cloud``); keys ``head``, ``record:<number>``, ``wait:<id>``, ``once:<day>:<id>``; and
``chains``, which lists them. See ``services/audit/audit_log.py``."""
FORGET = "Forget"
"""Partition: shard; key: ``<due ms>:<hash of the target>``."""
WORKERS = "Workers"
"""Partition ``workers``: key: name of a worker. Partition ``probes``: key: name of a host, written by its server."""
MAILBOX = "Mailbox"
"""Partition: agent id; keys ``<0 for Stop, 1>:<oldest first>:<command id>``, ``ack:<command id>``."""

TRIES = 12
_PAUSE_S = 0.002

T = TypeVar("T")


def read(row: Row, kind: type[T]) -> T:
    """The record in a row. Fields of newer versions are ignored."""
    return msgspec.convert(row.data, kind, strict=False)


def to_data(record: Any) -> dict[str, Any]:
    """The row data of a record."""
    data: dict[str, Any] = msgspec.to_builtins(record)
    return data


def write(existing: Row | None, partition: str, key: str, data: Mapping[str, Any]) -> Write:
    """The write that creates a row, or changes the existing one."""
    if existing is None:
        return Write("create", Row(partition, key, data))
    return Write("replace", existing.changed(data))


async def find(tables: Tables, table: str, partition: str, key: str, kind: type[T]) -> tuple[Row | None, T | None]:
    """The row and its record; ``None`` twice if there is no such row."""
    row = await tables.get(table, partition, key)
    return row, None if row is None else read(row, kind)


async def update(tables: Tables, table: str, row: Row, record: Any) -> None:
    """Change the record of a row.

    Raises:
        Conflict: The row was changed concurrently.
    """
    await tables.replace(table, row.changed(to_data(record)))


async def discard(tables: Tables, table: str, row: Row | None) -> None:
    """Delete a row, unless there is none or it was changed concurrently."""
    if row is not None:
        with contextlib.suppress(Conflict):
            await tables.delete(table, row)


async def remove(tables: Tables, table: str, partition: str, key: str) -> None:
    """Delete the row at a place, as ``discard`` does."""
    await discard(tables, table, await tables.get(table, partition, key))


async def retry(change: Callable[[], Awaitable[T]]) -> T:
    """Run ``change`` (read, decide, write by ETag) again after conflicts.

    Raises:
        Problem: ``busy``, after twelve attempts.
    """
    for attempt in range(TRIES):
        try:
            return await change()
        except Conflict:
            if attempt:
                await asyncio.sleep(random.uniform(0, _PAUSE_S * attempt))  # noqa: S311 (spreads writers)
    raise busy_store()


async def upsert(  # noqa: PLR0917 (a place, a change, a type: read best in this order)
    tables: Tables, table: str, partition: str, key: str, change: Callable[[T | None], T | None], kind: type[T]
) -> T | None:
    """Change or create one record; ``change`` returns ``None`` to leave it unchanged."""

    async def attempt() -> T | None:
        row = await tables.get(table, partition, key)
        record = change(None if row is None else read(row, kind))
        if record is None:
            return None
        data = to_data(record)
        if row is None:
            await tables.create(table, Row(partition, key, data))
        else:
            await tables.replace(table, row.changed(data))
        return record

    return await retry(attempt)


async def page(tables: Tables, table: str, partition: str, **options: Any) -> Page:
    """A page of rows for a list of the API; options as for ``Tables.query``. Raises ``cursor-invalid``."""
    try:
        return await tables.query(table, partition, **options)
    except ValueError as error:
        raise invalid_cursor() from error


async def all_rows(
    tables: Tables, table: str, partition: str, *, first: str = "", last: str | None = None
) -> AsyncIterator[Row]:
    """Every row of a key range, read page by page."""
    cursor = None
    while True:
        rows = await tables.query(table, partition, first=first, last=last, limit=1000, cursor=cursor)
        for row in rows.rows:
            yield row
        cursor = rows.cursor
        if cursor is None:
            return
