"""The driver of ``examples/minimal_driver.py`` fulfils the driver contract."""

import runpy
from collections.abc import Iterator

import pytest

from device_agent.drivers.testing.driver_contract import DriverContract
from device_agent.drivers.testing.peer import Disturbance
from device_agent.ports.driver import REST, Driver, Twist
from device_agent.protocol.manifests import robot_type as robot_types
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.paths import ROOT, UR5


class Motors:
    """The motors that the example only imagines: they are where they were commanded."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver

    def joint_positions(self) -> tuple[float, ...]:
        return self._driver.observe().position_rad

    def joint_velocities(self) -> tuple[float, ...]:
        return self._driver.observe().velocity_rad_s

    def base_twist(self) -> Twist:
        return REST

    def disturb(self, disturbance: Disturbance) -> None:
        raise NotImplementedError(disturbance)

    def restore(self) -> None:
        raise NotImplementedError


class TestMinimalDriver(DriverContract):
    simulated = True
    absent = dict.fromkeys(Disturbance, "the example has no hardware")

    @pytest.fixture
    def robot_type(self) -> RobotType:
        return robot_types.load(UR5)

    @pytest.fixture
    def driver(self, robot_type: RobotType) -> Iterator[Driver]:
        example = runpy.run_path(str(ROOT / "examples" / "minimal_driver.py"))
        driver = example["create"](robot_type, ROOT, {}, "arm")
        yield driver
        driver.close()

    @pytest.fixture
    def peer(self, driver: Driver) -> Motors:
        return Motors(driver)
