"""``MemoryTables``, which the unit tests of the services use, fulfils the port's contract."""

import pytest

from function_app.ports.tables import Tables
from tests.contract.tables.suite import Again, TablesSuite
from tests.fakes.tables import MemoryTables


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture
def tables() -> Tables:
    return MemoryTables()


@pytest.fixture
def again(tables: MemoryTables) -> Again:
    async def open_() -> Tables:
        return MemoryTables(tables)

    return open_


class TestMemoryTables(TablesSuite):
    pass
