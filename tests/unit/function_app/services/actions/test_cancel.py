"""Cancelling an action: who may, with which epoch, and what an ended action keeps."""

import pytest

from device_agent.protocol import AckStatus, CancelAction
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.unit.function_app.services.actions.queue_requests import control_rows, queued
from tests.unit.function_app.services.sharing.shares import share


def row(cloud: Cloud, action: str) -> object:
    device, _, suffix = action.rpartition("-")
    return cloud.run(cloud.functions.tables.get(records.CONTROL, device, f"action:{suffix}"))


def test_a_viewer_may_not_cancel_and_a_stranger_sees_no_action(
    cloud: Cloud, anna: Person, bert: Person, robot: Robot, running: str
) -> None:
    problem(bert.post(f"/actions/{running}/cancel"), 404, "action-unknown")
    share(anna, f"devices/{robot.device}", bert, "viewer")
    before = row(cloud, running)
    problem(bert.post(f"/actions/{running}/cancel"), 403, "forbidden")
    assert bert.action(running)["status"] == "started"
    assert robot.received(CancelAction) == []
    assert row(cloud, running) == before


def test_the_command_has_the_epoch_of_a_newer_lease(anna: Person, robot: Robot, running: str) -> None:
    """A device rejects commands with an epoch below the newest one."""
    epoch = anna.take_lease(robot.device).json()["epoch"]
    assert epoch > anna.action(running)["epoch"]
    assert anna.post(f"/actions/{running}/cancel").status_code == 202
    (cancel,) = robot.received(CancelAction)
    assert (cancel.epoch, cancel.caller) == (epoch, "anna")


@pytest.mark.parametrize("end", [AckStatus.DONE, AckStatus.FAILED])
def test_an_ended_action_does_not_change(
    cloud: Cloud, anna: Person, robot: Robot, running: str, end: AckStatus
) -> None:
    robot.report(running, end)
    before = row(cloud, running)
    answer = anna.post(f"/actions/{running}/cancel")
    assert (answer.status_code, answer.json()["status"]) == (202, end.value)
    assert row(cloud, running) == before
    assert robot.received(CancelAction) == []


def test_a_repeated_cancellation_is_sent_again_but_stored_once(
    cloud: Cloud, anna: Person, robot: Robot, running: str
) -> None:
    anna.post(f"/actions/{running}/cancel")
    before = row(cloud, running)
    anna.post(f"/actions/{running}/cancel")
    assert row(cloud, running) == before
    assert len(robot.received(CancelAction)) == 2


def test_without_a_broker_the_cancellation_is_stored_and_fails(
    cloud: Cloud, anna: Person, robot: Robot, broker: MemoryBroker, running: str
) -> None:
    broker.reachable = False
    problem(anna.post(f"/actions/{running}/cancel"), 503, "broker-unavailable")
    assert control_rows(cloud, robot.device)[f"action:{running.rpartition('-')[2]}"]["cancel_requested"] is True


def test_a_cancelled_queued_action_is_not_sent_to_the_device(anna: Person, robot: Robot, running: str) -> None:
    action = queued(anna, robot.device)
    shown = anna.post(f"/actions/{action}/cancel").json()
    assert (shown["status"], shown["reason"]["code"]) == ("cancelled", "cancelled")
    assert "cancelled_ms" in shown["times"]
    robot.report(running, AckStatus.DONE)
    assert robot.received(CancelAction) == []


@pytest.mark.parametrize("action", ["x", "agent00000-arm-00000000000000000000"])
def test_an_unknown_action_is_reported(anna: Person, action: str) -> None:
    problem(anna.post(f"/actions/{action}/cancel"), 404, "action-unknown")
    problem(anna.get(f"/actions/{action}"), 404, "action-unknown")


def test_an_action_of_an_earlier_pairing_does_not_exist(anna: Person, robot: Robot, running: str) -> None:
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    robot.pair(anna)
    problem(anna.get(f"/actions/{running}"), 404, "action-unknown")
    problem(anna.post(f"/actions/{running}/cancel"), 404, "action-unknown")


def test_the_list_contains_the_actions_since_the_pairing(anna: Person, robot: Robot) -> None:
    robot.reports = lambda _: (AckStatus.DONE,)
    path = f"/devices/{robot.device}/actions"
    for _ in range(3):
        anna.start(robot.device)
    assert [len(page) for page in anna.each_page(path, limit=2)] == [2, 1]
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    robot.pair(anna)
    robot.connect()
    new = anna.start(robot.device).json()["id"]
    page = anna.get(path, params={"limit": 2}).json()
    assert ([item["id"] for item in page["items"]], page["cursor"]) == ([new], None)
