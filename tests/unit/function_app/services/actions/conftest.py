"""Fixtures of the action tests."""

import pytest

from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Person


@pytest.fixture
def running(anna: Person, robot: Robot) -> str:
    """An action that runs on the robot."""
    action: str = anna.start(robot.device, wait_ms=10_000).json()["id"]
    return action
