"""Every device of the laboratory, by its own driver."""

from collections.abc import Iterator

import pytest

from device_agent.ports.sensor import RoomDriver
from device_agent.protocol.manifests import room
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.perception import driver as perception
from device_agent.simulation import renderer
from tests.contract.sensors.suite import RoomDriverContract
from tests.harness.agent.rooms import LAB, ManualWorld

DEVICES = {device.name: device for device in room.load(LAB).devices}


@pytest.fixture(scope="module")
def world() -> ManualWorld:
    return ManualWorld()


@pytest.fixture(scope="module")
def neighbours(world: ManualWorld) -> Iterator[dict[str, RoomDriver]]:
    """The sensors of perception, connected."""
    found = {name: world.driver(name) for name, device in DEVICES.items() if device.driver != "perception"}
    for driver in found.values():
        driver.connect()
    yield found
    for driver in found.values():
        driver.close()


@pytest.mark.parametrize("name", DEVICES)
class TestLab(RoomDriverContract):
    @pytest.fixture
    def entry(self, name: str) -> RoomDeviceManifest:
        return DEVICES[name]

    @pytest.fixture
    def driver(
        self,
        entry: RoomDeviceManifest,
        world: ManualWorld,
        neighbours: dict[str, RoomDriver],
        monkeypatch: pytest.MonkeyPatch,
    ) -> Iterator[RoomDriver]:
        monkeypatch.setattr(perception, "SURVEY_EVERY_S", 0.0)
        monkeypatch.setattr(renderer, "TIMEOUT_S", 60.0)
        world.advance(0.02)
        driver = world.driver(entry, neighbours)
        yield driver
        driver.close()
