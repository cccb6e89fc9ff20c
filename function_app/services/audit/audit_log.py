"""What was done in an account, in a chain that shows when anything of it was changed or taken away.

One chain for each account that owns something, in a partition of ``Audit``. A record and the new head are one batch by
the head's ETag: writers in any number of processes take turns and never fork it. What one process has to write at the
same time goes into one batch.

Nothing that was acknowledged is missing. A change of the account is noted (``wait:<id>``) before the write that decides
it, and its record takes the note away in its own batch; what a killed process leaves, the timer records as ``unknown``.
What ``services/audit.py`` tells comes at least once, from rows written in the batch of the change, and is recorded once
by its id (``once:<day>:<id>``). Heads are noted elsewhere, against a chain that is cut off: see the architecture page.
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

LOOK_MS: Final = 15_000
"""The timer looks at a chain so long after something was noted for it, at most twice that."""
ABANDON_MS: Final = 60_000
"""A change that was noted and not finished for so long was cut off."""
ANCHOR_MS: Final = 3_600_000
KEEP_IDS_MS: Final = 30 * DAY_MS
"""What is told comes again within seconds; a store may be away for longer."""
QUIET_MS: Final = 10_000
"""The same refusal of the same person is recorded once in this time by a process: who tries on fills no table."""
_AT_ONCE: Final = 30
"""Records in one batch: two rows each, and the head."""
_TRIES: Final = 60
_PAUSE_S: Final = 0.1
_KNOWN: Final = 4096
_NOTE: Final = "audit:"
_ANCHOR: Final = "anchor:"
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
    """One record to be: with the note that it takes away, or the id by which it is recorded once."""

    fields: dict[str, Any]
    waiting: Row | None = None
    once: str = ""


class Change:
    """A change that is being made. Until it ends, ``data`` may be added to, and it may have ``came_to_nothing``."""

    def __init__(self, chain: "AuditLog", owner: str, fields: Entry) -> None:
        self.data: dict[str, Any] = dict(fields.data)
        self._chain = chain
        self._owner = owner
        self._entry = fields
        self._row: Row | None = None
        self.came_to_nothing = False

    async def noted(self) -> None:
        """Note it: to be called before the write that decides, any number of times.

        Raises:
            StoreError: The tables cannot be used; the change must not be made.
        """
        if self._row is None:
            self._row = await self._chain.open(self._owner, replace(self._entry, outcome="unknown"))

    async def end(self, outcome: Outcome) -> None:
        """Say how it ended, where it was noted."""
        if self._row is not None and self.came_to_nothing and outcome == "done":
            await self._chain.drop(self._row)
        elif self._row is not None:
            entry = replace(self._entry, outcome=outcome, data=self.data)
            await self._chain.close(self._owner, entry, self._row)


class AuditLog:
    """Writes the chains. Reading and verifying them: ``services/audit_trail.py``."""

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
        self._batches = WriteBatcher(self._write, most=_AT_ONCE)
        self._noted: OrderedDict[tuple[str, str, int], None] = OrderedDict()
        self._refused: OrderedDict[tuple[str, ...], int] = OrderedDict()

    @contextlib.asynccontextmanager
    async def change(
        self, owner: str, what: str, caller: Identity | None, *, on: str = "", **data: Any
    ) -> AsyncGenerator[Change]:
        """Record a change that is made within: call ``noted`` before the write that decides it.

        Where that is never called nothing was changed and nothing is recorded. A ``Problem`` after it is recorded as
        refused; after any other end the timer records that nobody knows.

        Args:
            owner: The account in whose chain it stands; ``CLOUD``: none.
            what: A ``Deed`` or ``Fact``.
            caller: Who does it.
            on: To what.
            data: What else is to be known. No secrets.

        Raises:
            StoreError: It could not be noted.
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
        """Record what has happened.

        Raises:
            StoreError: The tables cannot be used.
        """
        at_ms = self._clock.now_ms()
        await self.append(
            owner, rules.entry(what, caller, entry_id=new_id(), at_ms=at_ms, on=on, outcome=outcome, **data)
        )

    async def record_rejection(
        self, owner: str, what: str, caller: Identity | None, *, on: str = "", each: bool = False, **data: Any
    ) -> None:
        """Record a refusal; the same again and again once in a while only, but where it says ``each``.

        Whatever goes wrong with that: the refusal stands.
        """
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
            _log.warning("audit of a refusal: %s", error)

    async def append(self, owner: str, entry: Entry) -> None:
        """Record ``entry``; where others are in the way for long, the timer does.

        Raises:
            StoreError: The tables cannot be used.
        """
        try:
            await self._batches.add(owner, [_Job(entry.fields())])
        except Problem:
            await self.open(owner, entry)

    async def append_all(self, owner: str, entries: Sequence[Entry]) -> None:
        """Record what comes at least once, each once by its id.

        Raises:
            Problem: ``busy``: tell it again.
            StoreError: The tables cannot be used.
        """
        jobs = []
        for each in entries:
            day = each.at_ms // DAY_MS
            if self._new(_ONCE, owner, day):
                # Before the first id of a day, so that nothing stays that nobody forgets.
                span = (f"{_ONCE}{day:08d}:", f"{_ONCE}{day:08d};")
                due_ms = (self._clock.now_ms() // DAY_MS + 1) * DAY_MS + KEEP_IDS_MS
                await self._retention.delete_rows_at(records.AUDIT, owner, first=span[0], last=span[1], due_ms=due_ms)
            jobs.append(_Job(each.fields(), once=f"{_ONCE}{day:08d}:{each.id}"))
        await self._batches.add(owner, jobs)

    async def check(self, owner: str) -> None:
        """The timer's look: record what was left.

        Raises:
            Problem: ``busy``.
            StoreError: The tables cannot be used.
        """
        page = await self._tables.query(records.AUDIT, owner, first=_WAIT, last="wait;", limit=1000)
        now_ms = self._clock.now_ms()
        since_ms = now_ms - ABANDON_MS
        left = [row for row in page.rows if row.data["outcome"] != "unknown" or row.data["at_ms"] <= since_ms]
        await self._batches.add(owner, [_Job(dict(row.data), waiting=row) for row in left])
        if len(left) < len(page.rows) or page.cursor is not None:
            await self._reminders.schedule(f"{_NOTE}{owner}", now_ms + LOOK_MS)

    async def anchor(self, owner: str) -> None:
        """Note the head where whoever can write the tables need not be able to.

        Raises:
            StoreError: The stores cannot be used.
        """
        row = await self._tables.get(records.AUDIT, owner, _HEAD)
        if row is None:
            return
        line = json.dumps({name: row.data[name] for name in ("seq", "hash", "at_ms", "key", "signature")}) + "\n"
        await self._blobs.append(anchors(owner), line.encode())
        _log.info("audit head of %s: %s:%s", owner, row.data["seq"], row.data["hash"])

    async def open(self, owner: str, entry: Entry) -> Row:
        """Note an entry for the timer.

        Raises:
            StoreError: The tables cannot be used.
        """
        now_ms = self._clock.now_ms()
        due_ms = (now_ms // LOOK_MS + 2) * LOOK_MS
        if self._new(_NOTE, owner, due_ms):
            await self._reminders.schedule(f"{_NOTE}{owner}", due_ms)
        return await self._tables.create(records.AUDIT, Row(owner, f"{_WAIT}{entry.id}", entry.fields()))

    async def close(self, owner: str, entry: Entry, waiting: Row) -> None:
        """Record how a noted change ended. It is made: whatever goes wrong here, the timer records it."""
        fields = entry.fields()
        try:
            await self._batches.add(owner, [_Job(fields, waiting=waiting)])
        except (Problem, StoreError) as error:
            _log.warning("audit of %s: %s", entry.what, error)
            with contextlib.suppress(Conflict, StoreError):
                await self._tables.replace(records.AUDIT, replace(waiting, data=fields))

    async def drop(self, waiting: Row) -> None:
        """Take a note back: there is nothing to be recorded."""
        with contextlib.suppress(Conflict):
            await self._tables.delete(records.AUDIT, waiting)

    def _new(self, what: str, owner: str, when: int) -> bool:
        """Whether this process has not noted it yet."""
        key = (what, owner, when)
        created = key not in self._noted
        self._noted[key] = None
        _bound(self._noted, key)
        return created

    async def _write(self, owner: str, jobs: list[_Job]) -> None:
        await self._note_anchor(owner)
        jobs = _each_once(jobs)
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
                if not await self._are_there(owner, head.seq + 1, jobs):
                    continue
            return
        raise busy_store()

    async def _are_there(self, owner: str, seq: int, jobs: list[_Job]) -> bool:
        """Whether a batch that was refused is there: its answer was lost, and what was sent again came too late."""
        first, last = record_key(seq), record_key(seq + len(jobs))
        page = await self._tables.query(records.AUDIT, owner, first=first, last=last, limit=len(jobs))
        there = [(row.data.get("id"), row.data.get("outcome")) for row in page.rows]
        return there == [(job.fields["id"], job.fields["outcome"]) for job in jobs]

    async def _open(self, owner: str, jobs: list[_Job]) -> list[_Job]:
        """Those that nobody else has recorded meanwhile."""
        still = []
        for job in jobs:
            if job.once and await self._tables.get(records.AUDIT, owner, job.once) is not None:
                continue
            if job.waiting is not None:
                row = await self._tables.get(records.AUDIT, owner, job.waiting.key)
                if row is None and job.fields["outcome"] == "unknown":
                    continue
                # Where the timer has said that nobody knows, the end is told as well.
                still.append(replace(job, waiting=row))
            else:
                still.append(job)
        return still

    async def _try(self, owner: str, row: Row | None, head: Head, jobs: list[_Job]) -> None:
        """Write ``jobs`` behind ``head``, which is what ``row`` says, all or none."""
        writes = []
        for job in jobs:
            head, record = rules.append(head, job.fields)
            writes.append(Write("create", Row(owner, record_key(head.seq), record)))
            if job.waiting is not None:
                writes.append(Write("delete", job.waiting))
            if job.once:
                writes.append(Write("create", Row(owner, job.once, {"seq": head.seq})))
        signed = await self._signed(owner, head)
        writes.append(Write("replace" if row else "create", Row(owner, _HEAD, signed, row.etag if row else "")))
        await self._tables.batch(records.AUDIT, writes)

    async def _signed(self, owner: str, head: Head) -> dict[str, Any]:
        key = await self._keys.current()
        at_ms = self._clock.now_ms()
        signature = base64.urlsafe_b64encode(key.sign(rules.signed_bytes(owner, head, at_ms))).decode()
        name = signing.key_id(key.public_key())
        return {"seq": head.seq, "hash": head.hash, "at_ms": at_ms, "key": name, "signature": signature}

    async def _note_anchor(self, owner: str) -> None:
        """Before the write, so that no head stays without one; and list the chain."""
        due_ms = (self._clock.now_ms() // ANCHOR_MS + 1) * ANCHOR_MS
        if self._new(_ANCHOR, owner, due_ms):
            with contextlib.suppress(Conflict):
                await self._tables.create(records.AUDIT, Row(_CHAINS, owner, {}))
            await self._reminders.schedule(f"{_ANCHOR}{owner}", due_ms)


def record_key(seq: int) -> str:
    """The key of a record: they sort by number."""
    return f"{_RECORD}{seq:012d}"


def anchors(owner: str) -> str:
    """The blob to which the heads of a chain are noted, a line each."""
    return f"audit/{owner}/heads.jsonl"


def chain_of(note: str) -> str | None:
    """The chain that a note of the timer is about; ``None`` where it is about something else."""
    return note.removeprefix(_NOTE) if note.startswith(_NOTE) else None


def anchor_of(note: str) -> str | None:
    """The chain whose head is to be noted elsewhere; ``None`` where a note of the timer is about something else."""
    return note.removeprefix(_ANCHOR) if note.startswith(_ANCHOR) else None


def _each_once(jobs: list[_Job]) -> list[_Job]:
    """Without what two have brought at the same time: the later one of the same note knows more."""
    named = {job.once or (job.waiting.key if job.waiting else str(id(job))): job for job in jobs}
    return list(named.values())


def _bound(existing: OrderedDict[Any, Any], newest: Any) -> None:
    existing.move_to_end(newest)
    if len(existing) > _KNOWN:
        existing.popitem(last=False)
