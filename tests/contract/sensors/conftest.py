"""A broker of a house for all tests of a module, and drivers that are closed after the test."""

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from device_agent import sensors
from device_agent.config.agent_config import DeviceEntry
from device_agent.ports.sensor import RoomDriver, SensorError, Surroundings
from device_agent.protocol.manifests.room import RoomDeviceManifest
from tests.harness.network.brokers import wait_until
from tests.harness.robots.room_devices.house_broker import HouseBroker

MakeEntry = Callable[..., RoomDeviceManifest]
MakeDriver = Callable[[RoomDeviceManifest], RoomDriver]


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[HouseBroker]:
    with HouseBroker(tmp_path_factory.mktemp("house")) as house:
        yield house


@pytest.fixture
def make_driver(tmp_path: Path) -> Iterator[MakeDriver]:
    """Makes drivers as the agent does. Afterwards they are closed, and have no threads left."""
    before = set(threading.enumerate())
    drivers: list[RoomDriver] = []

    def make(entry: RoomDeviceManifest) -> RoomDriver:
        drivers.append(sensors.load(entry.driver)(entry, tmp_path, Surroundings(neighbours={})))
        return drivers[-1]

    yield make
    for driver in drivers:
        driver.close()
    own = {thread for thread in threading.enumerate() if thread not in before}
    names = {f"{driver.device.name}-" for driver in drivers}  # type: ignore[attr-defined]
    assert not [thread.name for thread in own if thread.name.startswith(tuple(names))]


def described(driver: str, options: dict[str, Any], **description: Any) -> RoomDeviceManifest:
    """A device as an entry of ``agent.toml`` describes it."""
    entry = {"name": "device", "type": "test_device", "driver": driver, "options": options, **description}
    return msgspec.convert(entry, DeviceEntry).room_device()


def sample(driver: RoomDriver, stream: str) -> dict[str, float | bool]:
    """The next sample of a stream."""
    found: dict[str, float | bool] = {}

    def arrived() -> bool:
        found.update(driver.read(stream))
        return bool(found)

    wait_until(arrived, f"a sample of {stream}")
    return found


def error_of(call: Callable[[], object]) -> str:
    """The message with which a call fails; empty if it does not."""
    try:
        call()
    except SensorError as error:
        return str(error)
    return ""


def connects(driver: RoomDriver) -> bool:
    return not error_of(driver.connect)
