"""Steps of tests of camera drivers."""

from collections.abc import Callable

import pytest

from device_agent.ports.sensor import Frame, RoomDriver, SensorError
from device_agent.sensors.camera.driver import CameraDriver
from tests.harness.network.brokers import wait_until

CreateDriver = Callable[..., CameraDriver]


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
