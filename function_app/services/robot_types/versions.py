"""Stores the files of new versions, creates validation jobs and awaits verdicts."""

import asyncio
import contextlib
from collections.abc import Mapping

from function_app.domain.common.problems import Problem, busy_store, invalid
from function_app.domain.robot_types.robot_types import TypeVersion
from function_app.ports.blobs import Blobs
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Tables
from function_app.services.robot_types.model_validation import drop_files, store_verdict
from function_app.services.robot_types.rows import Place, add_job, read_version
from function_app.services.storage import records as store
from function_app.services.storage.quota import StorageQuota

GIVE_UP_MS = 120_000
"""Time after which an upload without a verdict is rejected."""
KEEP_PREVIEW_MS = 30 * 60_000
"""Time for which a preview can be saved."""
_POLL_S = 0.1


class TypeVersions:
    """Processes versions of robot types and previews."""

    def __init__(self, *, tables: Tables, blobs: Blobs, quota: StorageQuota, clock: Clock) -> None:
        self._tables = tables
        self._quota = quota
        self._blobs = blobs
        self._clock = clock

    async def store(self, where: Place, version: int, files: Mapping[str, bytes]) -> None:
        """Store the files of an ``uploading`` version, and create a validation job.

        Raises:
            Problem: ``busy``: it took too long, and the cleanup has rejected the version. ``quota-exceeded``,
                ``storage-full``: the version is rejected.
        """
        size = sum(len(content) for content in files.values())
        try:
            await self._quota.reserve(where.account, where.prefix(version), size)
        except Problem as problem:
            await store_verdict(self._tables, where, version, (problem.detail,), self._clock.now_ms())
            raise
        for name, content in files.items():
            await self._blobs.put(where.prefix(version) + name, content)
        row, upload = await read_version(self._tables, where, version)
        stored = False
        if row is not None and upload is not None and upload.state == "uploading":
            with contextlib.suppress(Conflict):
                await self._tables.replace(store.ROBOT_TYPES, row.changed({"state": "checking"}))
                stored = True
        if not stored:
            # The version was rejected or the type deleted: the files are not needed.
            await drop_files(self._tables, self._blobs, where, version)
            raise busy_store()
        await add_job(self._tables, where, version, self._clock.now_ms())

    async def verdict(self, where: Place, version: int, wait_ms: int) -> TypeVersion | None:
        """The version after its validation, or after ``wait_ms``."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + wait_ms / 1000
        while True:
            _, upload = await read_version(self._tables, where, version)
            left_s = end_s - loop.time()
            if upload is None or not upload.open or left_s <= 0:
                return upload
            await asyncio.sleep(min(_POLL_S, left_s))


def refused(upload: TypeVersion) -> Problem:
    """The rejection with all errors."""
    detail = " ".join(upload.errors) or "The model was rejected."
    return invalid(detail, code="robot-type-rejected", errors=list(upload.errors), version=upload.version)
