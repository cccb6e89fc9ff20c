"""Fixtures of the revocation tests."""

import pytest

from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person


@pytest.fixture
def operator(cloud: Cloud, pair: tuple[Person, Robot]) -> tuple[Person, Person, Robot]:
    """An owner, an operator of the owner's robot, and the robot."""
    anna, robot = pair
    bert = cloud.sign_in("bert")
    assert anna.post(f"/devices/{robot.device}/shares", {"account": "bert", "role": "operator"}).status_code == 201
    return anna, bert, robot
