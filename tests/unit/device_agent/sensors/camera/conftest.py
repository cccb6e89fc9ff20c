"""Drivers as ``agent.toml`` describes them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent import bootstrap
from device_agent.sensors.camera.driver import CameraDriver
from tests.harness.network.cameras.mjpeg import MjpegCamera
from tests.harness.network.cameras.steps import CreateDriver, entry


@pytest.fixture
def create(tmp_path: Path) -> Iterator[CreateDriver]:
    """Creates drivers without connecting them; the agent's folder is ``tmp_path``."""
    created: list[CameraDriver] = []

    def driver(name: str, **options: Any) -> CameraDriver:
        device = bootstrap.create_room_device(entry(name, **options), {}, home=tmp_path)
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
