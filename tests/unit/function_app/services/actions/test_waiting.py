"""Calls that wait for a device, when what they wait for came at an awkward moment."""

import time

from device_agent.protocol import AckStatus
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Person

ENDLESS_MS = 30_000


def test_an_end_that_came_before_the_call_was_listening_ends_its_waiting(pair: tuple[Person, Robot]) -> None:
    """The ingest holds acks back for a moment: neither the bus nor the tables show this one when the call begins."""
    anna, robot = pair
    action = anna.start(robot.device, wait_ms=10_000).json()["id"]
    robot.report(action, AckStatus.DONE)
    begun_s = time.monotonic()
    assert anna.action(action, wait_ms=ENDLESS_MS)["status"] == "done"
    assert time.monotonic() - begun_s < ENDLESS_MS / 1000 / 3
