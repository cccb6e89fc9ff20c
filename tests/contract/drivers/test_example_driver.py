"""The driver of ``examples/minimal_driver.py`` keeps the driver contract."""

import importlib.util
from collections.abc import Iterator

import pytest

from device_agent.ports.driver import Driver
from device_agent.protocol.manifests import robot_type as robot_types
from device_agent.protocol.manifests.robot_type import RobotType
from tests.contract.drivers.suite import DriverContract
from tests.harness.paths import ROOT


class TestMinimalDriver(DriverContract):
    @pytest.fixture
    def robot_type(self) -> RobotType:
        return robot_types.load(ROOT / "robots" / "ur5")

    @pytest.fixture
    def driver(self, robot_type: RobotType) -> Iterator[Driver]:
        spec = importlib.util.spec_from_file_location("minimal_driver", ROOT / "examples" / "minimal_driver.py")
        assert spec
        assert spec.loader
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        driver = module.create(robot_type, ROOT, {}, "arm")
        yield driver
        driver.close()
