"""Periodic cleanup of robot types: unvalidated uploads, unused versions and files."""

import logging
from collections.abc import Sequence

from function_app.domain.common.problems import Problem
from function_app.domain.robot_types.robot_types import TypeHead, TypeVersion
from function_app.ports.blobs import Blobs
from function_app.ports.clock import Clock
from function_app.ports.tables import Row, Tables
from function_app.services.robot_types.model_validation import drop_files, store_verdict
from function_app.services.robot_types.rows import (
    CHECKS,
    LOOKS,
    VERSIONS,
    Place,
    place_of,
    preview_index,
    read_head,
    read_refusal,
    schedule_check,
)
from function_app.services.robot_types.versions import GIVE_UP_MS, KEEP_PREVIEW_MS
from function_app.services.storage import records
from function_app.services.storage.retention import DAY_MS

RETRY_MS = 30_000
LONGEST_MS = 5 * GIVE_UP_MS
"""Maximum time that an upload waits while validators are busy."""
NOTES = 25
NO_VALIDATOR = (
    "No validator checked the model in time. Run `python -m function_app work` or `check-models` on a machine with "
    "MuJoCo, then upload it again."
)
INTERRUPTED = "The upload was interrupted. Upload it again."

_log = logging.getLogger(__name__)


class RobotTypeCleanup:
    """The cleanup jobs of the scheduler."""

    def __init__(self, *, tables: Tables, blobs: Blobs, clock: Clock) -> None:
        self._tables = tables
        self._blobs = blobs
        self._clock = clock

    async def run_due_jobs(self) -> None:
        """Run the due jobs. Idempotent and safe to run concurrently: each reminder is deleted last.

        Raises:
            StoreError: The stores are not available.
        """
        last = f"{self._clock.now_ms() + 1:013d}"
        page = await self._tables.query(records.MODEL_CHECKS, LOOKS, last=last, limit=NOTES)
        for note in page.rows:
            try:
                await self._check(place_of(note.key))
            except Problem as problem:
                _log.warning("robot types: %s", problem.detail)
                continue
            await records.discard(self._tables, records.MODEL_CHECKS, note)

    async def _check(self, where: Place) -> None:
        _, head = await read_head(self._tables, where)
        if head is None:
            if where.trial:
                await self._unlist(where)
            return
        page = await self._tables.query(
            records.ROBOT_TYPES, where.partition, first=VERSIONS, last=VERSIONS + "\x7f", limit=1000
        )
        if where.trial:
            await self._check_preview(where, head, page.rows)
            return
        for row in page.rows:
            await self._check_version(where, head, row)

    async def _check_preview(self, where: Place, head: TypeHead, rows: Sequence[Row]) -> None:
        """Check a preview: expire its version, then delete all of it, its index last."""
        now_ms = self._clock.now_ms()
        versions = [records.read(row, TypeVersion) for row in rows]
        if not head.deleted and any(now_ms < version.created_ms + KEEP_PREVIEW_MS for version in versions):
            for version in versions:
                if version.open:
                    await self._reject_if_overdue(where, version, now_ms)
            return
        for row, version in zip(rows, versions, strict=True):
            await self._drop(where, row, version)
        last, _ = await read_head(self._tables, where)
        await records.discard(self._tables, records.ROBOT_TYPES, last)
        await self._unlist(where)

    async def _unlist(self, where: Place) -> None:
        """Remove a preview from its account's list."""
        await records.remove(self._tables, records.MEMBERS, where.account, preview_index(where))

    async def _check_version(self, where: Place, head: TypeHead, row: Row) -> None:
        version = records.read(row, TypeVersion)
        now_ms = self._clock.now_ms()
        if version.state == "rejected" and version.version < head.last:
            await self._drop(where, row, version)
        elif not head.needs(version.version):
            # Superseded versions remain for one day, for running downloads.
            due_ms = 0 if head.deleted or version.version < head.since else head.ready_ms + DAY_MS
            if now_ms >= due_ms:
                await self._drop(where, row, version)
            else:
                await schedule_check(self._tables, where, due_ms)
        elif version.open:
            await self._reject_if_overdue(where, version, now_ms)

    async def _reject_if_overdue(self, where: Place, version: TypeVersion, now_ms: int) -> None:
        age_ms = now_ms - version.created_ms
        if age_ms < GIVE_UP_MS:
            await schedule_check(self._tables, where, version.created_ms + GIVE_UP_MS)
        elif version.state == "checking" and age_ms < LONGEST_MS and await self._busy(now_ms):
            await schedule_check(self._tables, where, now_ms + RETRY_MS)
        else:
            reason = INTERRUPTED
            if version.state == "checking":
                refusal = await read_refusal(self._tables)
                reason = f"The model was not checked: {refusal}" if refusal else NO_VALIDATOR
            await store_verdict(self._tables, where, version.version, (reason,), now_ms)

    async def _busy(self, now_ms: int) -> bool:
        """Whether a validator is working, so that this upload will get its turn."""
        page = await self._tables.query(records.MODEL_CHECKS, CHECKS, limit=100)
        return any(note.data["until_ms"] > now_ms for note in page.rows)

    async def _drop(self, where: Place, row: Row, version: TypeVersion) -> None:
        """Delete the files first: rows without files are deleted again, files without rows would be lost."""
        await drop_files(self._tables, self._blobs, where, version.version)
        await records.discard(self._tables, records.ROBOT_TYPES, row)
