"""Every device of the laboratory, by its own driver."""

from collections.abc import Iterator

import pytest

from device_agent.ports.sensor import RoomDriver
from device_agent.protocol import room
from device_agent.protocol.room import RoomDevice
from tests.contract.sensors.suite import RoomDriverContract
from tests.support.rooms import LAB, StillWorld

DEVICES = {device.name: device for device in room.load(LAB).devices}


@pytest.fixture(scope="module")
def world() -> StillWorld:
    return StillWorld()


@pytest.mark.parametrize("name", DEVICES)
class TestLab(RoomDriverContract):
    @pytest.fixture
    def entry(self, name: str) -> RoomDevice:
        return DEVICES[name]

    @pytest.fixture
    def driver(self, entry: RoomDevice, world: StillWorld) -> Iterator[RoomDriver]:
        neighbours: dict[str, RoomDriver] = {}
        world.go_on(0.02)
        driver = world.driver(entry, neighbours)
        yield driver
        driver.close()
