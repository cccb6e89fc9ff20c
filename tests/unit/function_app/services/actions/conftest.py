"""Fixtures of the action tests."""

import pytest

from tests.unit.function_app.services.actions.queue_requests import Pair


@pytest.fixture
def running(pair: Pair) -> str:
    """An action that runs on the robot."""
    anna, robot = pair
    action: str = anna.start(robot.device, wait_ms=10_000).json()["id"]
    return action
