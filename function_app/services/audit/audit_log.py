"""The audit log: a tamper-evident chain of records for each account.

A record and the new head are one batch with the head's ETag, so concurrent writers never fork the chain. Writes of one
process at the same time share a batch.

Every acknowledged change is recorded. A pending change is stored (``wait:<id>``) before its deciding write; the batch
with its record deletes this row. The timer records changes of killed processes as ``unknown``. Events of
``ControlEvents`` arrive at least once and are recorded once by id (``once:<day>:<id>``). Heads are also stored in the
blob store, to detect truncation.
"""

import asyncio
import base64
import contextlib
import json
import logging
import random
from collections import OrderedDict
from collections.abc import AsyncGenerator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from device_agent.protocol.security import signing
from function_app.domain.audit import hash_chain as rules
from function_app.domain.audit.hash_chain import Entry, Head, Outcome
from function_app.domain.common.ids import new_id
from function_app.domain.common.problems import Problem, busy_store
from function_app.domain.identity.accounts import Identity
from function_app.ports.blobs import Blobs
from function_app.ports.clock import Clock
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import Conflict, Row, StoreError, Tables, Write
from function_app.services.storage import records
from function_app.services.storage.reminders import Reminders
from function_app.services.storage.retention import DAY_MS, Retention
from function_app.services.storage.write_batcher import WriteBatcher

CHECK_MS: Final = 15_000
"""Delay after which the timer checks a chain for pending changes."""
ABANDON_MS: Final = 60_000
"""Age at which a pending change counts as interrupted."""
ANCHOR_MS: Final = 3_600_000
KEEP_IDS_MS: Final = 30 * DAY_MS
"""Time that ids of recorded events are stored. Retries arrive within seconds, or after an outage of the store."""
QUIET_MS: Final = 10_000
"""A process records the same rejection of the same person at most once in this time."""
_MAX_BATCH: Final = 30
"""Records in one batch: two rows each, and the head."""
_TRIES: Final = 60
_PAUSE_S: Final = 0.1
_CACHE_SIZE: Final = 4096
REMINDER: Final = "audit"
"""Kind of the reminders to check a chain for pending changes."""
ANCHOR_REMINDER: Final = "anchor"
"""Kind of the reminders to anchor the head of a chain."""
_WAIT: Final = "wait:"
_ONCE: Final = "once:"
_RECORD: Final = "record:"
_HEAD: Final = "head"
_CHAINS: Final = "chains"
"""Partition of ``Audit`` that lists the chains."""
_SERVER_ERROR: Final = 500

_log = logging.getLogger(__name__)


@dataclass(eq=False, slots=True)
class _Job:
    """A record to write, with the pending row to delete, or the id that makes it unique."""

    fields: dict[str, Any]
    waiting: Row | None = None
    once: str = ""


class Change:
    """A change in progress. Its ``data`` may be extended until it ends. ``discarded``: record nothing."""

    def __init__(self, chain: "AuditLog", owner: str, fields: Entry) -> None:
        self.data: dict[str, Any] = dict(fields.data)
        self._chain = chain
        self._owner = owner
        self._entry = fields
        self._row: Row | None = None
        self.discarded = False

    async def store_pending(self) -> None:
        """Store the pending change before the deciding write, which must not follow a ``StoreError``. Idempotent."""
        if self._row is None:
            self._row = await self._chain.open(self._owner, replace(self._entry, outcome="unknown"))

    async def end(self, outcome: Outcome) -> None:
        """Record the outcome, if the change was stored as pending."""
        if self._row is not None and self.discarded and outcome == "done":
            await self._chain.drop(self._row)
        elif self._row is not None:
            entry = replace(self._entry, outcome=outcome, data=self.data)
            await self._chain.close(self._owner, entry, self._row)


class AuditLog:
    """Writes the chains. ``AuditReader`` reads and verifies them."""

    def __init__(
        self,
        *,
        tables: Tables,
        blobs: Blobs,
        keys: SigningKeys,
        retention: Retention,
        reminders: Reminders,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._blobs = blobs
        self._keys = keys
        self._retention = retention
        self._reminders = reminders
        self._clock = clock
        self._batches = WriteBatcher(self._write, most=_MAX_BATCH)
        self._scheduled: OrderedDict[tuple[str, str, int], None] = OrderedDict()
        self._refused: OrderedDict[tuple[str, ...], int] = OrderedDict()

    @contextlib.asynccontextmanager
    async def change(
        self, owner: str, what: str, caller: Identity | None, *, on: str = "", **data: Any
    ) -> AsyncGenerator[Change]:
        """Record a change: call ``store_pending`` in the context before the deciding write, else nothing is recorded.

        A later ``Problem`` is recorded as rejected; after other exceptions the timer records ``unknown``. ``what`` is
        an ``AccountEvent`` or ``Fact``, ``on`` its target; ``data`` must not contain secrets.
        """
        at_ms = self._clock.now_ms()
        change = Change(self, owner, rules.entry(what, caller, entry_id=new_id(), at_ms=at_ms, on=on, **data))
        try:
            yield change
        except Problem as problem:
            change.data["code"] = problem.code
            await change.end("failed" if problem.status >= _SERVER_ERROR else "rejected")
            raise
        await change.end("done")

    async def record(
        self, owner: str, what: str, caller: Identity | None, *, on: str = "", outcome: Outcome = "done", **data: Any
    ) -> None:
        """Record an event."""
        at_ms = self._clock.now_ms()
        await self.append(
            owner, rules.entry(what, caller, entry_id=new_id(), at_ms=at_ms, on=on, outcome=outcome, **data)
        )

    async def record_rejection(
        self, owner: str, what: str, caller: Identity | None, *, on: str = "", each: bool = False, **data: Any
    ) -> None:
        """Record a rejection, best effort. Repetitions are recorded once per interval, unless ``each`` is set."""
        now_ms = self._clock.now_ms()
        code = str(data.get("code", ""))
        key = (owner, what, on, code, caller.session if caller else str(data.get("address", "")))
        if not each and now_ms - self._refused.get(key, -QUIET_MS) < QUIET_MS:
            return
        self._refused[key] = now_ms
        _bound(self._refused, key)
        try:
            await self.record(owner, what, caller, on=on, outcome="rejected", **data)
        except (StoreError, Problem) as error:
            _log.warning("audit of a rejection: %s", error)

    async def append(self, owner: str, entry: Entry) -> None:
        """Record ``entry``; under contention the timer writes it."""
        try:
            await self._batches.add(owner, [_Job(entry.fields())])
        except Problem:
            await self.open(owner, entry)

    async def append_all(self, owner: str, entries: Sequence[Entry]) -> None:
        """Record events that may arrive more than once; each is recorded once by id.

        Raises:
            Problem: ``busy``: retry.
            StoreError: The tables are not available.
        """
        jobs = []
        for each in entries:
            day = each.at_ms // DAY_MS
            if self._new(_ONCE, owner, day):
                # Schedule the deletion before the first id of a day is written.
                span = (f"{_ONCE}{day:08d}:", f"{_ONCE}{day:08d};")
                due_ms = (self._clock.now_ms() // DAY_MS + 1) * DAY_MS + KEEP_IDS_MS
                await self._retention.delete_rows_at(records.AUDIT, owner, first=span[0], last=span[1], due_ms=due_ms)
            jobs.append(_Job(each.fields(), once=f"{_ONCE}{day:08d}:{each.id}"))
        await self._batches.add(owner, jobs)

    async def check(self, owner: str) -> None:
        """Called by the timer: record interrupted changes. Raises ``busy``."""
        page = await self._tables.query(records.AUDIT, owner, first=_WAIT, last="wait;", limit=1000)
        now_ms = self._clock.now_ms()
        since_ms = now_ms - ABANDON_MS
        left = [row for row in page.rows if row.data["outcome"] != "unknown" or row.data["at_ms"] <= since_ms]
        await self._batches.add(owner, [_Job(dict(row.data), waiting=row) for row in left])
        if len(left) < len(page.rows) or page.cursor is not None:
            await self._reminders.schedule(f"{REMINDER}:{owner}", now_ms + CHECK_MS)

    async def anchor(self, owner: str) -> None:
        """Store the head in the blob store, which other credentials may protect."""
        row = await self._tables.get(records.AUDIT, owner, _HEAD)
        if row is None:
            return
        line = json.dumps({name: row.data[name] for name in ("seq", "hash", "at_ms", "key", "signature")}) + "\n"
        await self._blobs.append(anchors(owner), line.encode())
        _log.info("audit head of %s: %s:%s", owner, row.data["seq"], row.data["hash"])

    async def open(self, owner: str, entry: Entry) -> Row:
        """Store a pending entry for the timer."""
        now_ms = self._clock.now_ms()
        due_ms = (now_ms // CHECK_MS + 2) * CHECK_MS
        if self._new(REMINDER, owner, due_ms):
            await self._reminders.schedule(f"{REMINDER}:{owner}", due_ms)
        return await self._tables.create(records.AUDIT, Row(owner, f"{_WAIT}{entry.id}", entry.fields()))

    async def close(self, owner: str, entry: Entry, waiting: Row) -> None:
        """Record the outcome of a pending change, best effort: otherwise the timer records it."""
        fields = entry.fields()
        try:
            await self._batches.add(owner, [_Job(fields, waiting=waiting)])
        except (Problem, StoreError) as error:
            _log.warning("audit of %s: %s", entry.event, error)
            with contextlib.suppress(Conflict, StoreError):
                await self._tables.replace(records.AUDIT, waiting.changed(fields))

    async def drop(self, waiting: Row) -> None:
        """Delete a pending entry without a record."""
        await records.discard(self._tables, records.AUDIT, waiting)

    def _new(self, what: str, owner: str, when: int) -> bool:
        """Whether this process has not scheduled a check yet."""
        key = (what, owner, when)
        created = key not in self._scheduled
        self._scheduled[key] = None
        _bound(self._scheduled, key)
        return created

    async def _write(self, owner: str, jobs: list[_Job]) -> None:
        await self._schedule_anchor(owner)
        jobs = _without_duplicates(jobs)
        for attempt in range(_TRIES):
            if attempt:
                await asyncio.sleep(random.uniform(0, min(_PAUSE_S, 0.004 * attempt)))  # noqa: S311 (spreads writers)
                jobs = await self._open(owner, jobs)
            if not jobs:
                return
            row = await self._tables.get(records.AUDIT, owner, _HEAD)
            head = rules.genesis(owner) if row is None else Head(row.data["seq"], row.data["hash"])
            try:
                await self._try(owner, row, head, jobs)
            except Conflict:
                if not await self._were_written(owner, head.seq + 1, jobs):
                    continue
            return
        raise busy_store()

    async def _were_written(self, owner: str, seq: int, jobs: list[_Job]) -> bool:
        """Whether a rejected batch was written: its response was lost, and the client's retry was rejected."""
        first, last = record_key(seq), record_key(seq + len(jobs))
        page = await self._tables.query(records.AUDIT, owner, first=first, last=last, limit=len(jobs))
        written = [(row.data.get("id"), row.data.get("outcome")) for row in page.rows]
        return written == [(job.fields["id"], job.fields["outcome"]) for job in jobs]

    async def _open(self, owner: str, jobs: list[_Job]) -> list[_Job]:
        """The jobs that no other process has recorded."""
        remaining = []
        for job in jobs:
            if job.once and await self._tables.get(records.AUDIT, owner, job.once) is not None:
                continue
            if job.waiting is not None:
                row = await self._tables.get(records.AUDIT, owner, job.waiting.key)
                if row is None and job.fields["outcome"] == "unknown":
                    continue
                # The outcome is also recorded if the timer has recorded ``unknown`` before.
                remaining.append(replace(job, waiting=row))
            else:
                remaining.append(job)
        return remaining

    async def _try(self, owner: str, row: Row | None, head: Head, jobs: list[_Job]) -> None:
        """Append ``jobs`` behind ``head``, which ``row`` contains, all or none."""
        writes = []
        for job in jobs:
            head, record = rules.append(head, job.fields)
            writes.append(Write("create", Row(owner, record_key(head.seq), record)))
            if job.waiting is not None:
                writes.append(Write("delete", job.waiting))
            if job.once:
                writes.append(Write("create", Row(owner, job.once, {"seq": head.seq})))
        signed = await self._signed(owner, head)
        writes.append(records.write(row, owner, _HEAD, signed))
        await self._tables.batch(records.AUDIT, writes)

    async def _signed(self, owner: str, head: Head) -> dict[str, Any]:
        key = await self._keys.current()
        at_ms = self._clock.now_ms()
        signature = base64.urlsafe_b64encode(key.sign(rules.signed_bytes(owner, head, at_ms))).decode()
        name = signing.key_id(key.public_key())
        return {"seq": head.seq, "hash": head.hash, "at_ms": at_ms, "key": name, "signature": signature}

    async def _schedule_anchor(self, owner: str) -> None:
        """Schedule the anchor of the head before the write, and list the chain."""
        due_ms = (self._clock.now_ms() // ANCHOR_MS + 1) * ANCHOR_MS
        if self._new(ANCHOR_REMINDER, owner, due_ms):
            with contextlib.suppress(Conflict):
                await self._tables.create(records.AUDIT, Row(_CHAINS, owner, {}))
            await self._reminders.schedule(f"{ANCHOR_REMINDER}:{owner}", due_ms)


def record_key(seq: int) -> str:
    """Row key of a record; keys sort by number."""
    return f"{_RECORD}{seq:012d}"


def anchors(owner: str) -> str:
    """The blob with the heads of a chain, one per line."""
    return f"audit/{owner}/heads.jsonl"


def _without_duplicates(jobs: list[_Job]) -> list[_Job]:
    """The jobs without duplicates; the later job with the same id has more data."""
    unique = {job.once or (job.waiting.key if job.waiting else str(id(job))): job for job in jobs}
    return list(unique.values())


def _bound(existing: OrderedDict[Any, Any], newest: Any) -> None:
    existing.move_to_end(newest)
    if len(existing) > _CACHE_SIZE:
        existing.popitem(last=False)
