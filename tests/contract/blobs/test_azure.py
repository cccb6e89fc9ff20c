"""``AzureBlobs`` keeps the port's promises over Azurite, and says clearly what is wrong with the real thing."""

import secrets
from collections.abc import AsyncIterator, Iterator

import pytest

from function_app.adapters.azure.blobs import AzureBlobs
from function_app.adapters.azure.client import Place
from function_app.ports.blobs import Blobs
from tests.contract.blobs.suite import Again, BlobsSuite
from tests.support.azure import start_azurite


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(scope="module")
def connection() -> Iterator[str]:
    with start_azurite() as connection:
        yield connection


@pytest.fixture
def container() -> str:
    """A container of each test's own."""
    return f"test{secrets.token_hex(8)}"


@pytest.fixture
async def blobs(connection: str, container: str) -> AsyncIterator[Blobs]:
    blobs = AzureBlobs(place=Place(connection), container=container)
    yield blobs
    await blobs.close()


@pytest.fixture
async def again(connection: str, container: str) -> AsyncIterator[Again]:
    opened: list[AzureBlobs] = []

    async def open_() -> Blobs:
        opened.append(AzureBlobs(place=Place(connection), container=container))
        return opened[-1]

    yield open_
    for each in opened:
        await each.close()


class TestAzureBlobs(BlobsSuite):
    pass
