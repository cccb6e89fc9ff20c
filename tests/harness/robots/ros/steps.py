"""Steps of the tests of the driver at an arm behind rosbridge."""

import time
from collections.abc import Callable

from device_agent import drivers
from device_agent.drivers.ros import RosDriver
from device_agent.protocol.manifests import robot_type as robot_types
from tests.harness.paths import ROBOTS, UR5
from tests.harness.robots.ros.peer import RosPeer

TYPE = robot_types.load(UR5)
QBO = robot_types.load(ROBOTS / "qbo")
HOME = tuple(TYPE.home_rad[joint.name] for joint in TYPE.joints)
_WAIT_S = 60.0


def create(peer: RosPeer, **changes: object) -> RosDriver:
    driver = drivers.load("ros")(TYPE, UR5, {**peer.options(), **changes}, "arm")
    assert isinstance(driver, RosDriver)
    return driver


def until(condition: Callable[[], object]) -> None:
    end_s = time.monotonic() + _WAIT_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.002)
