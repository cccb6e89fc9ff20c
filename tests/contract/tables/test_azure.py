"""``AzureTables`` keeps the port's promises over Azurite, and says clearly what is wrong with the real thing."""

import secrets
from collections.abc import AsyncIterator, Iterator

import pytest

from function_app.adapters.azure.client import Place
from function_app.adapters.azure.tables import AzureTables
from function_app.ports.tables import Tables
from tests.contract.tables.suite import Again, TablesSuite
from tests.support.azure import start_azurite


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(scope="module")
def connection() -> Iterator[str]:
    with start_azurite() as connection:
        yield connection


@pytest.fixture
def prefix() -> str:
    """Tables of each test's own."""
    return f"test{secrets.token_hex(8)}"


@pytest.fixture
async def tables(connection: str, prefix: str) -> AsyncIterator[Tables]:
    tables = AzureTables(place=Place(connection), prefix=prefix)
    yield tables
    await tables.close()


@pytest.fixture
async def again(connection: str, prefix: str) -> AsyncIterator[Again]:
    opened: list[AzureTables] = []

    async def open_() -> Tables:
        opened.append(AzureTables(place=Place(connection), prefix=prefix))
        return opened[-1]

    yield open_
    for each in opened:
        await each.close()


class TestAzureTables(TablesSuite):
    pass
