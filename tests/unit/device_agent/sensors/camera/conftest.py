"""Drivers as ``agent.toml`` describes them."""

from collections.abc import Iterator
from typing import Any

import pytest

from device_agent import bootstrap
from device_agent.config.agent_config import DeviceEntry
from device_agent.sensors.camera.driver import CameraDriver
from tests.harness.network.cameras.mjpeg import MjpegCamera
from tests.harness.network.cameras.steps import CreateDriver


@pytest.fixture
def create() -> Iterator[CreateDriver]:
    """Creates drivers without connecting them."""
    created: list[CameraDriver] = []

    def driver(name: str, **options: Any) -> CameraDriver:
        entry = DeviceEntry(name="door", type="camera", driver=name, options=options)
        device = bootstrap.create_room_device(entry, {})
        assert device is not None
        assert isinstance(device.driver, CameraDriver)
        created.append(device.driver)
        return device.driver

    yield driver
    for each in created:
        each.close()


@pytest.fixture
def camera() -> Iterator[MjpegCamera]:
    camera = MjpegCamera()
    yield camera
    camera.close()
