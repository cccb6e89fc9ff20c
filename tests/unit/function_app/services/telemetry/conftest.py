"""Fixtures of the telemetry tests."""

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from tests.unit.function_app.services.telemetry.house import House


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture
async def house(tmp_path: Path) -> AsyncIterator[House]:
    house = House(tmp_path)
    await house.pair()
    yield house
    await house.tables.close()
