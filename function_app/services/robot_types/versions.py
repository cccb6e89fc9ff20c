"""Versions of robot types on their way: files stored, a checker asked, its verdict waited for."""

import asyncio
import contextlib
from collections.abc import Mapping

from function_app.domain.common.problems import Problem, busy_store, invalid
from function_app.domain.robot_types.robot_types import TypeVersion
from function_app.ports.blobs import Blobs
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.robot_types.model_validation import drop_files
from function_app.services.robot_types.rows import CHECKS, Place, read_version
from function_app.services.storage import records as store

GIVE_UP_MS = 120_000
"""From then on an upload without a verdict is refused."""
KEEP_LOOK_MS = 30 * 60_000
"""So long an upload that was only looked at can be saved."""
_LOOK_S = 0.1


class TypeVersions:
    """What follows once a version has its row, be it of a robot type or of a look at one."""

    def __init__(self, *, tables: Tables, blobs: Blobs, clock: Clock) -> None:
        self._tables = tables
        self._blobs = blobs
        self._clock = clock

    async def store(self, where: Place, version: int, files: Mapping[str, bytes]) -> None:
        """Store the files of a version that is ``uploading``, and leave a note for the checkers.

        Raises:
            Problem: ``busy``: it took so long that the timer has given it up.
        """
        for name, content in files.items():
            await self._blobs.put(where.prefix(version) + name, content)
        row, upload = await read_version(self._tables, where, version)
        there = False
        if row is not None and upload is not None and upload.state == "uploading":
            data = {**row.data, "state": "checking"}
            with contextlib.suppress(Conflict):
                await self._tables.replace(store.ROBOT_TYPES, Row(row.partition, row.key, data, row.etag))
                there = True
        if not there:
            # It took so long that the timer gave it up, or the type was deleted: nobody needs the files.
            await drop_files(self._blobs, where, version)
            raise busy_store()
        key = f"{self._clock.now_ms():013d}:{where.partition}:{version}"
        await self._tables.create(store.MODEL_CHECKS, Row(CHECKS, key, {"version": version, "until_ms": 0, "tries": 0}))

    async def verdict(self, where: Place, version: int, wait_ms: int) -> TypeVersion | None:
        """The version once there is a verdict, or as it is after ``wait_ms``."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + wait_ms / 1000
        while True:
            _, upload = await read_version(self._tables, where, version)
            left_s = end_s - loop.time()
            if upload is None or not upload.open or left_s <= 0:
                return upload
            await asyncio.sleep(min(_LOOK_S, left_s))


def refused(upload: TypeVersion) -> Problem:
    """The refusal with all that is wrong."""
    detail = " ".join(upload.errors) or "The model was refused."
    return invalid(detail, code="robot-type-rejected", errors=list(upload.errors), version=upload.version)
