"""Actions and Stop of agents that poll for commands: acks are read from the tables."""

from collections.abc import Iterator

import pytest

from device_agent.protocol import AckStatus, Reason
from function_app.domain.actions.action import ASK_MS
from function_app.domain.devices.devices import POLL_SILENT_MS
from tests.harness.cloud.cloud import MOVE, Cloud, Person
from tests.harness.cloud.polling import PollingRobot
from tests.unit.function_app.services.actions.queue_requests import pass_time


@pytest.fixture
def anna(cloud: Cloud) -> Person:
    return cloud.sign_in("anna")


@pytest.fixture
def robot(cloud: Cloud, anna: Person) -> Iterator[PollingRobot]:
    with PollingRobot(cloud) as robot:
        robot.pair(anna)
        yield robot.open_link()


def test_a_call_waits_for_its_time_and_not_longer(cloud: Cloud, anna: Person, robot: PollingRobot) -> None:
    before_ms = cloud.clock.now_ms()
    answer = anna.start(robot.device, wait_ms=700)
    assert (answer.status_code, answer.json()["status"]) == (202, "published")
    assert 700 <= cloud.clock.now_ms() - before_ms <= 720


def test_a_call_returns_at_the_next_read_after_the_ack_is_stored(
    cloud: Cloud, anna: Person, robot: PollingRobot
) -> None:
    before_ms = cloud.clock.now_ms()
    body = {"request": MOVE, "wait_ms": 20_000}
    call = anna.begin("POST", f"/devices/{robot.device}/actions", json=body)
    (item,) = robot.fetch()
    robot.post_ack(item["id"], AckStatus.STARTED)
    answer = call()
    assert (answer.status_code, answer.json()["status"]) == (200, "started")
    assert {"published_ms", "started_ms"} <= set(answer.json()["times"])
    assert cloud.clock.now_ms() - before_ms < 500


def test_an_expired_command_can_be_fetched_once_more_to_ask_for_its_outcome(
    cloud: Cloud, anna: Person, robot: PollingRobot
) -> None:
    action = anna.start(robot.device, ttl_ms=2_000).json()["id"]
    pass_time(cloud, 6)
    assert anna.action(action)["status"] == "unknown"
    assert [item["id"] for item in robot.fetch()] == [action]
    cloud.clock.advance(ASK_MS / 1000)
    assert robot.fetch() == []


@pytest.mark.parametrize(("silent_ms", "outcome"), [(POLL_SILENT_MS // 2, "sent"), (2 * POLL_SILENT_MS, "unreachable")])
def test_stop_of_an_agent_that_stopped_polling_is_unreachable(
    cloud: Cloud, anna: Person, robot: PollingRobot, silent_ms: int, outcome: str
) -> None:
    robot.fetch()
    cloud.clock.advance(silent_ms / 1000)
    answer = anna.post(f"/devices/{robot.device}/stop")
    assert (answer.status_code, answer.json()["outcome"]) == (202, outcome)


def test_a_rejected_reset_names_the_reason_of_the_device(anna: Person, robot: PollingRobot) -> None:
    call = anna.begin("POST", f"/devices/{robot.device}/stop/reset")
    (item,) = robot.fetch()
    robot.post_ack(item["id"], AckStatus.FAILED, reason=Reason(code="device_stopped", message="protective stop"))
    assert call().json() == {"confirmed": False, "reason": {"code": "device_stopped", "message": "protective stop"}}


def test_a_confirmed_reset_has_no_reason(anna: Person, robot: PollingRobot) -> None:
    call = anna.begin("POST", f"/devices/{robot.device}/stop/reset")
    (item,) = robot.fetch()
    robot.post_ack(item["id"], AckStatus.DONE, reason=Reason(code="odd", message="odd"))
    assert call().json() == {"confirmed": True, "reason": None}
