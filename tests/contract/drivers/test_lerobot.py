"""The driver of LeRobot's robots fulfils the driver contract, with LeRobot itself at an emulated servo bus.

Each version of LeRobot for which this machine has a Python is tested.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.drivers import load
from device_agent.drivers.testing.driver_contract import DriverContract
from device_agent.drivers.testing.peer import Disturbance
from device_agent.ports.driver import Driver
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.paths import LEROBOT_PYTHONS, ROBOTS
from tests.harness.robots.lerobot.peer import ServoPeer


class TestSo101(DriverContract):
    """Feetech STS3215 servos."""

    robot = "so101_follower"
    folder = ROBOTS / "so101"
    absent = dict.fromkeys([Disturbance.ORDER], "each servo has an id, and answers in the requested order")

    @pytest.fixture
    def robot_type(self) -> RobotType:
        return robot_type.load(self.folder)

    @pytest.fixture(params=LEROBOT_PYTHONS, ids="lerobot-{}".format)
    def peer(self, request: pytest.FixtureRequest, robot_type: RobotType, tmp_path: Path) -> Iterator[ServoPeer]:
        peer = ServoPeer(robot_type, self.robot, LEROBOT_PYTHONS[request.param], tmp_path)
        yield peer
        peer.close()

    @pytest.fixture
    def driver(self, robot_type: RobotType, peer: ServoPeer) -> Iterator[Driver]:
        driver = load("lerobot")(robot_type, self.folder, peer.options(), "arm")
        yield driver
        driver.close()


class TestKoch(TestSo101):
    """Dynamixel X servos."""

    robot = "koch_follower"
    folder = ROBOTS / "koch"


class TestLeKiwi(TestSo101):
    """The arm on a base with three wheels, whose velocity the servos keep without commands."""

    robot = "lekiwi"
    folder = ROBOTS / "lekiwi"
