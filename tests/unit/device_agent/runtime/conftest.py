"""Fixtures of the runtime's tests."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.harness.agent.device_harness import DeviceHarness


@pytest.fixture
def harness(tmp_path: Path) -> Iterator[DeviceHarness]:
    """A running, connected device."""
    harness = DeviceHarness(tmp_path)
    harness.start()
    yield harness
    harness.stop()
