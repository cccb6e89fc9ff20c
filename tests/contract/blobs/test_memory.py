"""``MemoryBlobs``, which the unit tests of the services use, fulfils the port's contract."""

from collections.abc import AsyncIterator

import httpx
import pytest
from fastapi import FastAPI, Response

from function_app.domain.common.problems import Problem
from function_app.entrypoints.http.framework.routing import PREFIX
from function_app.entrypoints.http.telemetry import blob_transfers
from function_app.ports.blobs import Blobs
from tests.contract.blobs.suite import Again, BlobsSuite, Direct
from tests.fakes.blobs import MemoryBlobs

BASE = "http://telescope.test"


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture
def blobs() -> Blobs:
    return MemoryBlobs()


@pytest.fixture
def again(blobs: MemoryBlobs) -> Again:
    async def open_() -> Blobs:
        return MemoryBlobs(blobs)

    return open_


@pytest.fixture
async def direct() -> AsyncIterator[Direct]:
    blobs = MemoryBlobs(url=f"{BASE}{PREFIX}/blobs")
    app = FastAPI()
    app.include_router(blob_transfers.router(blobs))
    app.add_exception_handler(Problem, lambda _, error: Response(str(error), error.status))
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url=BASE) as client:
        yield Direct(blobs, client)


class TestMemoryBlobs(BlobsSuite):
    pass
