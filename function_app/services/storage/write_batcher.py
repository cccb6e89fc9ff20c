"""Gathers what one process has to write to one place at the same time, so that it is written together."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import Generic, TypeVar

from function_app.domain.common.problems import Problem
from function_app.ports.tables import StoreError

J = TypeVar("J")


class _Line(Generic[J]):
    """Those who wait for one place."""

    def __init__(self) -> None:
        self.lock = asyncio.Lock()
        self.jobs: list[tuple[J, asyncio.Future[None]]] = []


class WriteBatcher(Generic[J]):
    """One batch at a time for each place; whoever comes meanwhile is in the next.

    Args:
        write: Writes some to a place, all or none.
        most: Not more than so many at once.
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
                    # Whoever is called off does not take the others' jobs along.
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
                done.exception()  # whoever waits may have gone
        else:
            for _, done in batch:
                done.set_result(None)
