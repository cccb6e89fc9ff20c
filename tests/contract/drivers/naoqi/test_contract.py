"""The driver of NAO robots fulfils the driver contract, over NAOqi's real protocol."""

from collections.abc import Iterator

import pytest

from device_agent.drivers import load
from device_agent.drivers.testing.driver_contract import DriverContract
from device_agent.ports.driver import Driver
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.paths import NAOQI_PYTHON, ROBOTS
from tests.harness.robots.naoqi.peer import NaoPeer


class TestNaoqi(DriverContract):
    """At NAOqi's services on loopback."""

    in_physics = False

    @pytest.fixture
    def robot_type(self) -> RobotType:
        return robot_type.load(ROBOTS / "nao")

    @pytest.fixture
    def peer(self, robot_type: RobotType) -> Iterator[NaoPeer]:
        peer = NaoPeer(robot_type, NAOQI_PYTHON, simulated=self.in_physics)
        yield peer
        peer.close()

    @pytest.fixture
    def driver(self, robot_type: RobotType, peer: NaoPeer) -> Iterator[Driver]:
        driver = load("naoqi")(robot_type, ROBOTS / "nao", peer.options(), "nao")
        yield driver
        driver.close()


class TestNaoqiInPhysics(TestNaoqi):
    """The same services of the simulated NAO, which stands and walks in MuJoCo."""

    in_physics = True

    def nudged(self, robot_type: RobotType, position: tuple[float, ...]) -> tuple[float, ...]:
        """As in the suite, but for the legs: the robot would fall."""
        target = super().nudged(robot_type, position)
        names = [joint.name for joint in robot_type.joints]
        return tuple(
            before if any(part in name for part in ("Hip", "Knee", "Ankle")) else after
            for name, before, after in zip(names, position, target, strict=True)
        )
