"""Validates uploaded models: a validator with MuJoCo takes a job, compiles the model and stores the verdict.

A job is leased by its ETag, so two validators never have the same job. The job of a killed validator is taken again.
"""

import asyncio
import logging
from collections.abc import AsyncIterator, Sequence
from dataclasses import replace

import msgspec

from device_agent.protocol.manifests.robot_type import MANIFEST, RobotType
from function_app.domain.robot_types.robot_types import State, TypeVersion, with_ready
from function_app.ports.blobs import Blobs
from function_app.ports.clock import Clock
from function_app.ports.model_compiler import CompilerMissingError, ModelCompiler, ModelReport, UnconfinedError
from function_app.ports.tables import Conflict, Row, Tables, Write
from function_app.services.robot_types.package_reader import malformed, missing
from function_app.services.robot_types.rows import (
    CHECKS,
    REPORT,
    Place,
    after_account,
    job_target,
    read_head,
    read_version,
    record_refusal,
    schedule_check,
)
from function_app.services.storage import quota, records
from function_app.services.storage.retention import DAY_MS

LEASE_MS = 60_000
"""Lease of a job [ms]: longer than the time limit of a compilation."""
MAX_TRIES = 3
"""After this number of interrupted attempts the model is rejected."""
MAX_ERRORS = 20
MAX_ERROR = 500

_log = logging.getLogger(__name__)


class ModelValidator:
    """Processes validation jobs."""

    def __init__(self, *, tables: Tables, blobs: Blobs, compiler: ModelCompiler, clock: Clock) -> None:
        self._tables = tables
        self._blobs = blobs
        self._compiler = compiler
        self._clock = clock
        self._next = ""

    async def require(self) -> None:
        """Check that models can be compiled here. A machine that cannot confine the compiler is recorded.

        Raises:
            CompilerMissingError: There is no compiler, or it cannot be confined.
            StoreError: The stores are not available.
        """
        try:
            await self._compiler.require()
        except UnconfinedError as error:
            await record_refusal(self._tables, str(error))
            raise
        await record_refusal(self._tables, "")

    async def run(self) -> bool:
        """Process one job; return whether there was one.

        Raises:
            CompilerMissingError: There is no compiler; the job is released.
            StoreError: The stores are not available.
        """
        async for note in self._in_turn():
            if note.data["until_ms"] > self._clock.now_ms():
                continue
            try:
                taken = await self._take(note)
            except Conflict:
                continue  # taken by another validator
            self._next = after_account(note)
            try:
                await self._check(taken)
                await self._tables.delete(records.MODEL_CHECKS, taken)
            except CompilerMissingError:
                await self._tables.replace(records.MODEL_CHECKS, replace(note, etag=taken.etag))
                raise
            except Conflict:
                _log.warning("check %s took too long and was taken by another validator", note.key)
            return True
        return False

    async def _in_turn(self) -> AsyncIterator[Row]:
        """The jobs, beginning with those of the next account: accounts take turns, however many jobs each has."""
        for first in (self._next, ""):
            async for note in records.all_rows(self._tables, records.MODEL_CHECKS, CHECKS, first=first):
                yield note

    async def _take(self, note: Row) -> Row:
        until_ms = self._clock.now_ms() + LEASE_MS
        data = {**note.data, "until_ms": until_ms, "tries": note.data["tries"] + 1}
        return await self._tables.replace(records.MODEL_CHECKS, note.changed(data))

    async def _check(self, note: Row) -> None:
        where, number = job_target(note)
        _, upload = await read_version(self._tables, where, number)
        if upload is not None and upload.state == "checking":
            if note.data["tries"] > MAX_TRIES:
                report = ModelReport((f"The validation was interrupted {MAX_TRIES} times. Simplify the model.",))
            else:
                report = await self._compile(where, upload)
            # The drawing is stored first: a ready version has one.
            await self._blobs.put(where.prefix(number) + REPORT, msgspec.json.encode(report))
            warnings = _sentences(report.warnings)
            await store_verdict(self._tables, where, number, report.errors, self._clock.now_ms(), warnings=warnings)
            _, upload = await read_version(self._tables, where, number)
        if upload is None:
            await drop_files(self._tables, self._blobs, where, number)  # the cleanup may have run concurrently

    async def _compile(self, where: Place, upload: TypeVersion) -> ModelReport:
        names = list(upload.files)
        contents = await asyncio.gather(*(self._blobs.get(where.prefix(upload.version) + name) for name in names))
        files = {name: content for name, content in zip(names, contents, strict=True) if content is not None}
        if len(files) < len(names):
            return ModelReport(("A file of the upload is missing. Upload it again.",))
        manifest = msgspec.convert(upload.manifest, RobotType)
        del files[MANIFEST]
        missing_files = missing(files)
        report = await self._compiler.check(manifest, files, [name for _, name, _ in missing_files])
        known = [error for error in report.errors if not any(name in error for _, name, _ in missing_files)]
        malformed_files = [error for error in malformed(files) if not any(_file(one) == _file(error) for one in known)]
        references = [f"{file}: '{name}' is not among the files (line {line})" for file, name, line in missing_files]
        return replace(report, errors=(*known, *references, *malformed_files))


async def drop_files(tables: Tables, blobs: Blobs, where: Place, number: int) -> None:
    """Delete all files of a version."""
    for name in await blobs.list(where.prefix(number)):
        await blobs.delete(name)
    await quota.release(tables, where.account, where.prefix(number))


async def store_verdict(
    tables: Tables, where: Place, number: int, errors: Sequence[str], now_ms: int, *, warnings: tuple[str, ...] = ()
) -> None:
    """Store the verdict together with earlier errors; a version that is no longer open stays unchanged.

    A ready version becomes active in the same batch; earlier versions are cleaned up after one day.
    """

    async def attempt() -> None:
        head_row, head = await read_head(tables, where)
        row, upload = await read_version(tables, where, number)
        if row is None or upload is None or head_row is None or head is None:
            return
        if not upload.open or not head.needs(number):
            return
        wrong = _sentences((*upload.errors, *errors))
        state: State = "rejected" if wrong else "ready"
        done = replace(upload, state=state, errors=wrong, warnings=warnings, checked_ms=now_ms)
        writes = [Write("replace", row.changed(records.to_data(done)))]
        if not wrong:
            await schedule_check(tables, where, now_ms + DAY_MS)
            head_data = records.to_data(with_ready(head, done))
            writes.append(Write("replace", head_row.changed(head_data)))
        await tables.batch(records.ROBOT_TYPES, writes)

    await records.retry(attempt)


def _sentences(texts: Sequence[str]) -> tuple[str, ...]:
    return tuple(_sentence(text) for text in texts[:MAX_ERRORS])


def _file(error: str) -> str:
    return error.partition(":")[0]


def _sentence(error: str) -> str:
    return error[:MAX_ERROR] + " …" if len(error) > MAX_ERROR else error.rstrip(".") + "."
