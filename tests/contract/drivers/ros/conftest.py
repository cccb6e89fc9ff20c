"""A robot behind an emulated rosbridge server, and its driver."""

from collections.abc import Iterator

import pytest

from device_agent import drivers
from device_agent.drivers.ros import RosBaseDriver, RosDriver
from tests.harness.paths import ROBOTS
from tests.harness.robots.ros.peer import RosPeer
from tests.harness.robots.ros.steps import QBO, TYPE, create


@pytest.fixture
def peer() -> Iterator[RosPeer]:
    peer = RosPeer(TYPE)
    yield peer
    peer.close()


@pytest.fixture
def driver(peer: RosPeer) -> Iterator[RosDriver]:
    driver = create(peer)
    yield driver
    driver.close()


@pytest.fixture
def mobile() -> Iterator[tuple[RosBaseDriver, RosPeer]]:
    peer = RosPeer(QBO)
    driver = drivers.load("ros")(QBO, ROBOTS / "qbo", peer.options(), "qbo")
    assert isinstance(driver, RosBaseDriver)
    driver.connect()
    yield driver, peer
    driver.close()
    peer.close()
