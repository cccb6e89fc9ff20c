"""The driver fulfils the contract of Telescope's drivers."""

from collections.abc import Iterator

import pytest

from device_agent.config import catalogue
from device_agent.drivers.testing.driver_contract import DriverContract
from device_agent.drivers.testing.template.driver import TemplateDriver
from device_agent.drivers.testing.template.peer import TemplatePeer
from device_agent.ports.driver import Driver
from device_agent.protocol.manifests.robot_type import RobotType


class TestTemplateDriver(DriverContract):
    """The driver at an emulated device."""

    driver_class: type[TemplateDriver] = TemplateDriver
    type_name = "ur5"

    @pytest.fixture
    def robot_type(self) -> RobotType:
        """The robot type."""
        return catalogue.TYPES.load(self.type_name)

    @pytest.fixture
    def peer(self, robot_type: RobotType) -> Iterator[TemplatePeer]:
        """The device."""
        peer = TemplatePeer(robot_type)
        yield peer
        peer.close()

    @pytest.fixture
    def driver(self, robot_type: RobotType, peer: TemplatePeer) -> Iterator[Driver]:
        """The driver."""
        driver = self.driver_class(robot_type, catalogue.TYPES.folder(self.type_name), peer.address, "device")
        yield driver
        driver.close()
