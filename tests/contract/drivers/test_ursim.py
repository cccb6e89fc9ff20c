"""The driver at a controller's own software: URSim, or a real arm. See ``docs/robots/universal-robots.md``."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import pytest

from device_agent import drivers
from device_agent.ports.driver import Driver, DriverError, ReportsFaults
from device_agent.ports.skills import HasBehaviours
from device_agent.protocol.manifests import robot_type as robot_types
from tests.harness.paths import ROOT, UR5

ADDRESS = os.environ.get("URSIM_HOST", "")
TYPE = robot_types.load(UR5)
STEP_RAD = 0.05
SPEED_RAD_S = 0.1
WITHIN_S = 20.0


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


@pytest.mark.ursim
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


class Action:
    """The context of a behaviour that nothing ends."""

    ended = False

    def wait(self, timeout_s: float) -> bool:
        return threading.Event().wait(timeout_s)


@pytest.mark.ursim
def test_a_running_arm_confirms_the_recoveries_that_change_nothing(driver: Driver) -> None:
    driver.connect()
    assert isinstance(driver, HasBehaviours)
    before = driver.observe().position_rad
    for behaviour in driver.behaviours:
        driver.run_behaviour(behaviour.name, Action())
    assert driver.observe().position_rad == pytest.approx(before, abs=0.005)


@pytest.mark.parametrize(("host", "selected"), [("", False), ("127.0.0.1", True)])
def test_the_tests_at_a_controller_are_deselected_without_its_address(host: str, selected: bool) -> None:
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider", __file__]
    environment = {**os.environ, "URSIM_HOST": host}
    collected = subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True, text=True).stdout
    assert ("test_a_controller_moves" in collected) is selected
    assert ("2 deselected" in collected) is not selected
