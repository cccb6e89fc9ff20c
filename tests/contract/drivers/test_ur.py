"""The driver for Universal Robots fulfils the driver contract, at an emulated controller."""

from collections.abc import Iterator

import pytest

from device_agent import drivers
from device_agent.drivers.testing.driver_contract import DriverContract
from device_agent.drivers.testing.peer import Disturbance
from device_agent.ports.driver import Driver
from device_agent.protocol.manifests import robot_type as robot_types
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.paths import UR5
from tests.harness.robots.universal_robots.peer import UrPeer


class TestUr(DriverContract):
    absent = dict.fromkeys([Disturbance.ORDER], "RTDE has a fixed order of the joints")

    @pytest.fixture
    def robot_type(self) -> RobotType:
        return robot_types.load(UR5)

    @pytest.fixture
    def peer(self, robot_type: RobotType) -> Iterator[UrPeer]:
        peer = UrPeer(robot_type)
        yield peer
        peer.close()

    @pytest.fixture
    def driver(self, robot_type: RobotType, peer: UrPeer) -> Iterator[Driver]:
        options = {"address": "127.0.0.1", "rtde_port": peer.rtde_port, "script_port": peer.script_port}
        driver = drivers.load("ur")(robot_type, UR5, options, "arm")
        yield driver
        driver.close()
