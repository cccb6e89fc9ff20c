"""Fixtures of the telemetry tests."""

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from tests.unit.function_app.services.telemetry.telemetry_fixture import TelemetrySetup


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture
async def setup(tmp_path: Path) -> AsyncIterator[TelemetrySetup]:
    setup = TelemetrySetup(tmp_path)
    await setup.pair()
    yield setup
    await setup.tables.close()
