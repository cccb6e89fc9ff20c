"""The driver at a controller's own software: URSim, or a real arm. See ``docs/robots/universal-robots.md``."""

import os
import time
from collections.abc import Iterator

import pytest

from device_agent import drivers
from device_agent.ports.driver import Driver, DriverError, ReportsFaults
from device_agent.protocol.manifests import robot_type as robot_types
from tests.harness.paths import UR5

ADDRESS = os.environ.get("TELESCOPE_URSIM", "")
TYPE = robot_types.load(UR5)
STEP_RAD = 0.05
SPEED_RAD_S = 0.1
WITHIN_S = 20.0

pytestmark = pytest.mark.skipif(not ADDRESS, reason="TELESCOPE_URSIM, the address of a controller, is not set")


@pytest.fixture
def driver() -> Iterator[Driver]:
    driver = drivers.load("ur")(TYPE, UR5, {"address": ADDRESS}, "arm")
    yield driver
    driver.close()


def move(driver: Driver, target: tuple[float, ...]) -> None:
    """Move on a straight line in joint space."""
    now = list(driver.observe().position_rad)
    step = SPEED_RAD_S * TYPE.period_ms / 1000
    end_s = time.monotonic() + WITHIN_S
    while driver.observe().position_rad != pytest.approx(target, abs=0.002):
        assert time.monotonic() < end_s
        now = [value + min(max(goal - value, -step), step) for value, goal in zip(now, target, strict=True)]
        driver.send(now)
        time.sleep(TYPE.period_ms / 1000)


def test_a_controller_moves_halts_and_connects_again(driver: Driver) -> None:
    driver.connect()
    assert isinstance(driver, ReportsFaults)
    assert not driver.faults(), "switch the arm on, and select remote control"
    home = driver.observe().position_rad
    there = (home[0] + STEP_RAD, *home[1:])
    move(driver, there)
    driver.halt()
    with pytest.raises(DriverError):
        driver.send(home)
    driver.connect()
    assert driver.observe().position_rad == pytest.approx(there, abs=0.005)
    move(driver, home)
    time.sleep(0.5)  # longer than the program's watchdog
    assert max(map(abs, driver.observe().velocity_rad_s)) < 0.01
    assert not driver.faults()
