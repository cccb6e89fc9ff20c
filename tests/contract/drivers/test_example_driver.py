"""The driver of ``examples/minimal_driver.py`` fulfils the driver contract."""

import runpy
from collections.abc import Iterator

import pytest

from device_agent.ports.driver import Driver
from device_agent.protocol.manifests import robot_type as robot_types
from device_agent.protocol.manifests.robot_type import RobotType
from tests.contract.drivers.suite import DriverContract
from tests.harness.paths import ROOT, UR5


class TestMinimalDriver(DriverContract):
    @pytest.fixture
    def robot_type(self) -> RobotType:
        return robot_types.load(UR5)

    @pytest.fixture
    def driver(self, robot_type: RobotType) -> Iterator[Driver]:
        example = runpy.run_path(str(ROOT / "examples" / "minimal_driver.py"))
        driver = example["create"](robot_type, ROOT, {}, "arm")
        yield driver
        driver.close()
