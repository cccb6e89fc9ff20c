"""Fixtures of the telemetry tests."""

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person
from tests.unit.function_app.services.telemetry.recordings_fixture import Recorder
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


@pytest.fixture
def recorder(cloud: Cloud, anna: Person, robot: Robot) -> Recorder:
    return Recorder(cloud, anna, robot)
