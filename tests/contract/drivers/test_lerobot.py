"""The driver of LeRobot's robots fulfils the driver contract, with LeRobot itself at an emulated servo bus."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.drivers import load
from device_agent.drivers.testing.driver_contract import DriverContract
from device_agent.drivers.testing.peer import Disturbance
from device_agent.ports.driver import Driver
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.paths import LEROBOT_PYTHON, ROBOTS
from tests.harness.robots.lerobot.peer import ServoPeer
from tests.harness.robots.lerobot.robot_types import lekiwi


class TestSo101(DriverContract):
    """Feetech STS3215 servos."""

    robot = "so101_follower"
    absent = dict.fromkeys([Disturbance.ORDER], "each servo has an id, and answers in the requested order")

    @pytest.fixture
    def robot_type(self) -> RobotType:
        return robot_type.load(ROBOTS / "so101")

    @pytest.fixture
    def peer(self, robot_type: RobotType, tmp_path: Path) -> Iterator[ServoPeer]:
        peer = ServoPeer(robot_type, self.robot, LEROBOT_PYTHON, tmp_path)
        yield peer
        peer.close()

    @pytest.fixture
    def driver(self, robot_type: RobotType, peer: ServoPeer) -> Iterator[Driver]:
        driver = load("lerobot")(robot_type, ROBOTS / "so101", peer.options(), "arm")
        yield driver
        driver.close()


class TestKoch(TestSo101):
    """Dynamixel X servos; the joints have the same names."""

    robot = "koch_follower"


class TestLeKiwi(TestSo101):
    """The arm on a base with three wheels, whose velocity the servos keep without commands."""

    robot = "lekiwi"

    @pytest.fixture
    def robot_type(self) -> RobotType:
        return lekiwi()
