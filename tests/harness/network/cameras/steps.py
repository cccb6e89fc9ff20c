"""Steps of tests of camera drivers."""

from collections.abc import Callable
from typing import Any

import pytest

from device_agent.config.agent_config import DeviceEntry
from device_agent.ports.sensor import Frame, RoomDriver, SensorError
from device_agent.protocol import CameraStream
from device_agent.protocol.manifests.room import Watch
from device_agent.sensors.camera.driver import CameraDriver
from tests.harness.network.brokers import wait_until

CreateDriver = Callable[..., CameraDriver]


def entry(driver: str, *, name: str = "door", **options: Any) -> DeviceEntry:
    """A camera as ``agent.toml`` describes it."""
    return DeviceEntry(
        name=name,
        type="camera",
        driver=driver,
        cameras=(CameraStream(name="colour", rate_hz=10.0),),
        captures=("image",),
        watch=(Watch(source="colour", silent_s=10.0, stuck_s=60.0),),
        options=options,
    )


def next_frame(driver: CameraDriver) -> Frame:
    frames: list[Frame] = []

    def arrived() -> bool:
        frame = driver.frame("colour")
        if frame is not None:
            frames.append(frame)
        return bool(frames)

    wait_until(arrived, "a frame")
    return frames[0]


def failure(driver: CameraDriver) -> str:
    """The message with which it does not connect."""
    with pytest.raises(SensorError) as error:
        driver.connect()
    return str(error.value)


def wait_for_connection(driver: RoomDriver) -> None:
    def connects() -> bool:
        try:
            driver.connect()
        except SensorError:
            return False
        return True

    wait_until(connects, "the camera")
