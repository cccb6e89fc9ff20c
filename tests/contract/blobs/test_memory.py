"""``MemoryBlobs``, which the unit tests of the services use, fulfils the port's contract."""

from collections.abc import AsyncIterator

import httpx
import pytest

from function_app.ports.blobs import Blobs
from tests.contract.blobs.suite import Again, BlobsSuite, Direct
from tests.contract.blobs.transfer_app import PATH, transfer_app
from tests.fakes.blobs import MemoryBlobs

HOST = "http://telescope.test"


class TestMemoryBlobs(BlobsSuite):
    @pytest.fixture
    def blobs(self) -> Blobs:
        return MemoryBlobs(url=HOST + PATH)

    @pytest.fixture
    def again(self, blobs: MemoryBlobs) -> Again:
        return lambda: MemoryBlobs(blobs)

    @pytest.fixture
    async def direct(self, blobs: MemoryBlobs) -> AsyncIterator[Direct]:
        transport = httpx.ASGITransport(transfer_app(blobs))
        async with httpx.AsyncClient(transport=transport, base_url=HOST) as client:
            yield Direct(blobs, client, served=True)
