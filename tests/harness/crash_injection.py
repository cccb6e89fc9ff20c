"""Processes that are killed between two writes."""

from collections.abc import Callable
from typing import Any

from function_app.ports.tables import Page, Row, Tables, Write
from tests.harness.cloud.cloud import Cloud, Person


class Killed(Exception):  # noqa: N818 (an outcome that the test wants)
    """The process is gone."""


class Knife:
    """Ends a process after its next so many writes."""

    def __init__(self) -> None:
        self.left: int | None = None
        self.written = 0

    def check(self) -> None:
        if self.left is not None and self.left <= 0:
            raise Killed

    def wrote(self) -> None:
        self.written += 1
        if self.left is not None:
            self.left -= 1
        self.check()


class CutTables:
    """Real tables of a process that the knife ends: after that it neither reads nor writes."""

    def __init__(self, inner: Tables, knife: Knife) -> None:
        self._inner = inner
        self._knife = knife

    async def get(self, table: str, partition: str, key: str) -> Row | None:
        self._knife.check()
        return await self._inner.get(table, partition, key)

    async def query(self, *arguments: Any, **options: Any) -> Page:
        self._knife.check()
        return await self._inner.query(*arguments, **options)

    async def create(self, table: str, row: Row) -> Row:
        created: Row = await self._cut(self._inner.create, table, row)
        return created

    async def replace(self, table: str, row: Row) -> Row:
        replaced: Row = await self._cut(self._inner.replace, table, row)
        return replaced

    async def delete(self, table: str, row: Row) -> None:
        await self._cut(self._inner.delete, table, row)

    async def batch(self, table: str, writes: list[Write]) -> tuple[Row, ...]:
        written: tuple[Row, ...] = await self._cut(self._inner.batch, table, writes)
        return written

    async def _cut(self, write: Callable[..., Any], *arguments: Any) -> Any:
        self._knife.check()
        done = await write(*arguments)
        self._knife.wrote()
        return done

    async def close(self) -> None:
        await self._inner.close()


def elsewhere(cloud: Cloud, person: Person) -> Person:
    """The same session, at another process."""
    account = {"id": person.account, "name": person.name}
    return Person(cloud, {"access_token": person.token, "account": account, "session": person.session})
