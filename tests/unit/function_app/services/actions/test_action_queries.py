"""Who may read and cancel an action, and what a cancel command contains."""

import pytest

from device_agent.protocol import AckStatus, CancelAction
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.unit.function_app.services.actions.queue_requests import control_rows

MISSING = "00000000000000000000"


def row(cloud: Cloud, robot: Robot, action: str) -> dict[str, object]:
    return control_rows(cloud, robot.device)[f"action:{action.rpartition('-')[2]}"]


def test_a_viewer_reads_an_action_and_cannot_cancel_it(cloud: Cloud, anna: Person, robot: Robot, running: str) -> None:
    viewer = cloud.sign_in("bert")
    assert anna.post(f"/devices/{robot.device}/shares", {"account": "bert", "role": "viewer"}).status_code == 201
    assert viewer.action(running)["status"] == "started"
    problem(viewer.post(f"/actions/{running}/cancel"), 403, "forbidden")
    assert robot.received(CancelAction) == []
    assert row(cloud, robot, running)["cancel_id"] == ""


@pytest.mark.parametrize("action", ["x", "no-command", "{device}-" + MISSING])
def test_an_unknown_action_is_named(anna: Person, robot: Robot, action: str) -> None:
    action = action.format(device=robot.device)
    for answer in (anna.get(f"/actions/{action}"), anna.post(f"/actions/{action}/cancel")):
        assert problem(answer, 404, "action-unknown")["detail"] == f"There is no action '{action}'."
        assert answer.json()["title"] == "No such action"


def test_a_second_cancel_keeps_the_first_command(cloud: Cloud, anna: Person, robot: Robot, running: str) -> None:
    anna.post(f"/actions/{running}/cancel")
    first = row(cloud, robot, running)["cancel_id"]
    assert isinstance(first, str)
    assert first.startswith(f"{robot.device}-")
    cloud.clock.advance(1)
    assert anna.post(f"/actions/{running}/cancel").status_code == 202
    assert row(cloud, robot, running)["cancel_id"] == first


def test_cancel_uses_the_epoch_of_a_newer_lease(anna: Person, robot: Robot, running: str) -> None:
    older = anna.action(running)["epoch"]
    newer = anna.take_lease(robot.device).json()["epoch"]
    assert newer > older
    anna.post(f"/actions/{running}/cancel")
    assert [command.epoch for command in robot.received(CancelAction)] == [newer]


def test_cancel_without_a_lease_uses_the_epoch_of_the_action(
    cloud: Cloud, anna: Person, robot: Robot, running: str
) -> None:
    tables = cloud.functions.tables
    stored = cloud.run(tables.get(records.CONTROL, robot.device, "now:lease"))
    assert stored is not None
    cloud.run(tables.delete(records.CONTROL, stored))
    anna.post(f"/actions/{running}/cancel")
    assert [command.epoch for command in robot.received(CancelAction)] == [anna.action(running)["epoch"]]


def test_cancel_without_a_broker_says_so_and_is_remembered(
    cloud: Cloud, anna: Person, robot: Robot, broker: MemoryBroker, running: str
) -> None:
    broker.reachable = False
    detail = problem(anna.post(f"/actions/{running}/cancel"), 503, "broker-unavailable")["detail"]
    assert "broker" in detail
    assert detail.endswith(".")
    assert row(cloud, robot, running)["cancel_id"] != ""
    broker.reachable = True
    robot.report(running, AckStatus.CANCELLED)
    assert anna.action(running)["status"] == "cancelled"
