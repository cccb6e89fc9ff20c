"""Fixtures of the sharing tests."""

import pytest

from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person
from tests.unit.function_app.services.sharing.shares import Three


@pytest.fixture
def three(cloud: Cloud, pair: tuple[Person, Robot]) -> Three:
    """Anna; Bert, with whom nothing is shared; and Anna's robot."""
    anna, robot = pair
    return anna, cloud.sign_in("bert"), robot
