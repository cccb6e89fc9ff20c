"""Fixtures of the telemetry tests."""

from collections.abc import AsyncIterator
from typing import Any

import pytest

from function_app.adapters.local.blobs import FileBlobs
from function_app.adapters.local.tables import SqliteTables
from tests.unit.function_app.services.telemetry.house import House


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture
async def house(tmp_path: Any) -> AsyncIterator[House]:
    tables = SqliteTables(tmp_path / "tables.sqlite")
    house = House(tables, FileBlobs(tmp_path / "blobs"))
    await house.pair()
    yield house
    await tables.close()
