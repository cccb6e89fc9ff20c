"""Combines concurrent writes of one process to the same place into batches."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import Generic, TypeVar

from function_app.domain.common.problems import Problem
from function_app.ports.tables import StoreError

J = TypeVar("J")


class _Line(Generic[J]):
    """The pending jobs of one place."""

    def __init__(self) -> None:
        self.lock = asyncio.Lock()
        self.jobs: list[tuple[J, asyncio.Future[None]]] = []


class WriteBatcher(Generic[J]):
    """Writes one batch at a time per place; jobs added meanwhile are in the next batch.

    Args:
        write: Writes jobs to a place, all or none.
        most: Maximum number of jobs per batch.
    """

    def __init__(self, write: Callable[[str, list[J]], Awaitable[None]], *, most: int) -> None:
        self._write = write
        self._most = most
        self._lines: dict[str, _Line[J]] = {}

    async def add(self, place: str, jobs: Sequence[J]) -> None:
        """Write ``jobs``, in order; returns when all are written.

        Raises:
            Problem: From ``write``.
            StoreError: From ``write``.
        """
        if not jobs:
            return
        loop = asyncio.get_running_loop()
        line = self._lines.setdefault(place, _Line())
        own = [(job, loop.create_future()) for job in jobs]
        line.jobs += own
        try:
            while not own[-1][1].done():
                async with line.lock:
                    if own[-1][1].done():
                        break
                    batch, line.jobs = line.jobs[: self._most], line.jobs[self._most :]
                    # Cancelling one caller must not cancel the jobs of others.
                    await asyncio.shield(asyncio.ensure_future(self._settle(place, batch)))
        finally:
            line.jobs = [each for each in line.jobs if each not in own]
            if not line.jobs and not line.lock.locked():
                self._lines.pop(place, None)
        for _, done in own:
            done.result()

    async def _settle(self, place: str, batch: list[tuple[J, "asyncio.Future[None]"]]) -> None:
        try:
            await self._write(place, [job for job, _ in batch])
        except (Problem, StoreError, ValueError) as error:
            for _, done in batch:
                done.set_exception(error)
                done.exception()  # the caller may have been cancelled
        else:
            for _, done in batch:
                done.set_result(None)
