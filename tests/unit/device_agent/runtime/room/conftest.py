"""The harness of a room device."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.unit.device_agent.runtime.room.room_device_fixture import RoomDeviceHarness


@pytest.fixture
def harness(tmp_path: Path) -> Iterator[RoomDeviceHarness]:
    harness = RoomDeviceHarness(tmp_path)
    yield harness
    harness.stop()
