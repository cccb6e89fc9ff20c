"""The harness of a fully capable fake robot."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.harness.agent.device_harness import DeviceHarness
from tests.unit.device_agent.runtime.actions.robot_api_fixture import AbleDriver, Head, able_type


@pytest.fixture
def harness(tmp_path: Path) -> Iterator[DeviceHarness]:
    harness = DeviceHarness(tmp_path, driver=AbleDriver(), kind=able_type(), geometry=Head())
    harness.start()
    yield harness
    harness.stop()
