"""Records in rows: which table, which key, and the one way to write when others write too."""

import asyncio
import random
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

import msgspec

from function_app.domain.common.problems import busy_store
from function_app.ports.tables import Conflict, Row, Tables

ACCOUNTS = "Accounts"
"""Partition: account id (or ``name:<name>``, ``open-id:<hash>``); keys ``account``, ``space:<id>``, ``session:<id>``,
``signed-out:<session>``, ``password``."""
SIGN_INS = "SignIns"
"""Partition: first letter of the token's hash; key: the hash."""
API_KEYS = "ApiKeys"
"""Partition: id of the key; key: ``key``. Index in ``Members``: ``api-key:<id>``."""
AGENTS = "Agents"
"""Partition: agent id; keys ``agent``, ``link``, ``state:<device name>``."""
CLAIMS = "Claims"
"""Partition: first letter of the code; key: the code."""
ATTEMPTS = "Attempts"
"""Partition: account id, ``name:<name>`` or ``address:<address>``; key: what is being tried."""
MEMBERS = "Members"
"""Partition: account id; keys ``agent:<agent id>``, ``share:device:<id>``, ``share:space:<id>``. Only an index: the
agent's own row says whose it is, the share's own what is shared."""
SHARES = "Shares"
"""Partition: ``device:<id>`` or ``space:<id>``; key ``account:<account id>``; and, as an index, with ``agent:<id>`` as
well, ``invitation:<id>``."""
INVITATIONS = "Invitations"
"""Partition: first letter of the secret's hash; key: the hash, which is the invitation's id."""
CONTROL = "Control"
"""Partition: device id; keys ``now:lease``, ``now:slot``, ``now:queue``, ``action:<suffix>``, ``once:<hash>``, and
``event:<id>``, what is still to be told among the device's events."""
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
"""Partition: ``<device>/<pairing>``; see ``services/faults.py``."""
DIAGNOSTICS = "Diagnostics"
"""Partition: ``<device>/<pairing>``; key: stream."""
WATCHERS = "Watchers"
"""Partition: device id; key: sign-in session. Who looks at it now; see ``services/watchers.py``."""
WATCHED = "Watched"
"""Partition: shard; keys ``<due ms>:<agent id>``, ``agent:<agent id>``."""
LATENCY = "Latency"
"""Partition: ``<device>/<pairing>``; see ``services/latency.py``."""
DATA = "Data"
"""Partition: shard; key: ``<arrival ms>:<id>``. What has come in and is not yet in its series."""
SERIES = "Series"
"""Partition: ``<device>/<pairing>``, key: stream; and ``<device>/<pairing>/<stream>``, see ``domain/series.py``."""
UPLOADS = "Uploads"
"""Partition: ``<device>/<pairing>``; see ``services/uploads.py``."""
EVENTS = "Events"
"""Partition: ``<device>/<pairing>``; key: counts down with time, newest first."""
AUDIT = "Audit"
"""Partition: account id (or ``cloud``); keys ``head``, ``record:<number>``, ``wait:<id>``, ``once:<day>:<id>``; and
``chains``, which lists them. See ``services/audit_chain.py``."""
FORGET = "Forget"
"""Partition: shard; key: ``<due ms>:<hash of what is to be deleted>``."""
MAILBOX = "Mailbox"
"""Partition: agent id; keys ``<0 for Stop, 1>:<oldest first>:<command id>``, ``ack:<command id>``."""

TRIES = 12
_PAUSE_S = 0.002

T = TypeVar("T")


def read(row: Row, kind: type[T]) -> T:
    """The record in a row. Fields that a newer version wrote are ignored."""
    return msgspec.convert(row.data, kind, strict=False)


def to_data(record: Any) -> dict[str, Any]:
    """A record as the data of a row."""
    data: dict[str, Any] = msgspec.to_builtins(record)
    return data


async def retry(change: Callable[[], Awaitable[T]]) -> T:
    """Do ``change`` (read, decide, write by ETag) again from its reading while others get in between.

    Raises:
        Problem: ``busy``, after a dozen tries.
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
    """Change one record that may not exist yet; ``change`` gives ``None`` to leave it as it is."""

    async def attempt() -> T | None:
        row = await tables.get(table, partition, key)
        record = change(None if row is None else read(row, kind))
        if record is None:
            return None
        data = to_data(record)
        if row is None:
            await tables.create(table, Row(partition, key, data))
        else:
            await tables.replace(table, Row(partition, key, data, row.etag))
        return record

    return await retry(attempt)
