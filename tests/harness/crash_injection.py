"""Processes that are killed between two writes."""

import itertools
import os
import signal
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

from function_app.ports.tables import Tables
from tests.harness.cloud.cloud import Cloud, Person

WRITES = frozenset({"create", "replace", "delete", "batch", "put", "append"})


class Killed(Exception):  # noqa: N818 (an outcome that tests expect)
    """The simulated process has ended."""


class CrashPoint:
    """Ends a simulated process after its next ``left`` writes; afterwards it neither reads nor writes."""

    def __init__(self) -> None:
        self.left: int | None = None
        self.written = 0

    @property
    def survived(self) -> bool:
        return self.left is None or self.left > 0

    async def read(self, call: Callable[..., Awaitable[Any]], *arguments: Any, **options: Any) -> Any:
        self._check()
        return await call(*arguments, **options)

    async def write(self, call: Callable[..., Awaitable[Any]], *arguments: Any) -> Any:
        self._check()
        result = await call(*arguments)
        self.written += 1
        if self.left is not None:
            self.left -= 1
        self._check()
        return result

    def _check(self) -> None:
        if not self.survived:
            raise Killed


class KillPoint:
    """Ends this process instead of step number ``at`` (counted from 0): a write, or a message to a device.

    Args:
        at: ``None``: never.
        simulated: Raise ``Killed`` at this step and all later ones; otherwise end the process, as ``kill -9`` does.
    """

    def __init__(self, at: int | None, *, simulated: bool = False) -> None:
        self._at = at
        self._steps = itertools.count()
        self._simulated = simulated
        self.reached = False

    async def read(self, call: Callable[..., Awaitable[Any]], *arguments: Any, **options: Any) -> Any:
        if self.reached:
            raise Killed
        return await call(*arguments, **options)

    async def write(self, call: Callable[..., Awaitable[Any]], *arguments: Any) -> Any:
        self.step()
        return await call(*arguments)

    def step(self) -> None:
        self.reached = self.reached or (self._at is not None and next(self._steps) >= self._at)
        if self.reached:
            if not self._simulated:
                os.kill(os.getpid(), signal.SIGKILL)
            raise Killed


def crashing_tables(tables: Tables, point: CrashPoint | KillPoint) -> Tables:
    """Tables of a process that ends at this point."""

    class CrashingTables:
        def __getattr__(self, name: str) -> Any:
            return partial(point.write if name in WRITES else point.read, getattr(tables, name))

        async def close(self) -> None:
            await tables.close()

    found: Any = CrashingTables()
    return found  # type: ignore[no-any-return]


def at_instance(cloud: Cloud, person: Person) -> Person:
    """The session of a person at another instance."""
    account = {"id": person.account, "name": person.name}
    return Person(cloud, {"access_token": person.token, "account": account, "session": person.session})
