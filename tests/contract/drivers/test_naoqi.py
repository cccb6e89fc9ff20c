"""The driver of NAO robots fulfils the driver contract, over NAOqi's real protocol."""

from collections.abc import Iterator

import pytest

from device_agent.drivers import load
from device_agent.drivers.testing.driver_contract import DriverContract
from device_agent.ports.driver import Driver
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.naoqi.peer import NaoPeer
from tests.harness.paths import NAOQI_PYTHON, ROBOTS


class TestNaoqi(DriverContract):
    """At NAOqi's services on loopback."""

    @pytest.fixture
    def robot_type(self) -> RobotType:
        return robot_type.load(ROBOTS / "nao")

    @pytest.fixture
    def peer(self, robot_type: RobotType) -> Iterator[NaoPeer]:
        peer = NaoPeer(robot_type, NAOQI_PYTHON)
        yield peer
        peer.close()

    @pytest.fixture
    def driver(self, robot_type: RobotType, peer: NaoPeer) -> Iterator[Driver]:
        driver = load("naoqi")(robot_type, ROBOTS / "nao", peer.options(), "nao")
        yield driver
        driver.close()
