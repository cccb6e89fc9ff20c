"""A start that meets an equal request, another operator, a waiting queue or an older agent."""

from typing import Any
from unittest import mock

import msgspec
import pytest

from device_agent.protocol import AckStatus, MoveJoints
from function_app.domain.devices.devices import Link
from function_app.ports.tables import Conflict
from function_app.services.actions.requests import ActionRequest
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.cloud.memory import Memory
from tests.unit.function_app.services.actions.queue_requests import QUEUE, control_rows, queued, sent
from tests.unit.function_app.services.actions.test_queue_repairs import end_silently
from tests.unit.function_app.services.sharing.shares import share

WAVE = {"kind": "run_movement", "name": "wave", "parameters": {"times": 2, "side": "left"}}
BASE: dict[str, Any] = {"request": WAVE, "policy": "queue"}


def fingerprint(**changes: Any) -> str:
    return msgspec.convert(BASE | changes, ActionRequest).fingerprint()


@pytest.mark.parametrize(
    "change",
    [
        {"request": WAVE | {"name": "nod"}},
        {"request": WAVE | {"parameters": {"times": 3, "side": "left"}}},
        {"epoch": 1},
        {"ttl_ms": 9_000},
        {"timeout_ms": 9_000},
        {"wait_ms": 9_000},
        {"wait_for": "done"},
        {"policy": "reject"},
        {"queue_ms": 9_000},
    ],
    ids=str,
)
def test_different_requests_have_different_fingerprints(change: dict[str, Any]) -> None:
    assert fingerprint(**change) != fingerprint()


def test_the_order_of_parameters_and_an_unused_queueing_time_do_not_matter() -> None:
    reordered = WAVE | {"parameters": {"side": "left", "times": 2}}
    assert fingerprint(request=reordered) == fingerprint()
    assert fingerprint(policy="reject", queue_ms=9_000) == fingerprint(policy="reject")


def test_a_request_that_the_agent_does_not_support_is_refused(cloud: Cloud, anna: Person, robot: Robot) -> None:
    tables = cloud.functions.tables
    agent = robot.device.partition("-")[0]
    row, link = cloud.run(records.find(tables, records.AGENTS, agent, "link", Link))
    assert row is not None
    assert link is not None
    for kinds, status in ((("say",), 422), (("say", "move_joints"), 200)):
        row = cloud.run(tables.replace(records.AGENTS, row.changed({**row.data, "capabilities": list(kinds)})))
        answer = anna.start(robot.device, wait_ms=10_000)
        assert answer.status_code == status
        if status == 422:
            refused = problem(answer, 422, "unable")
            assert refused["title"] == "The device cannot do this"
            assert "does not support the request 'move_joints'. Update the agent." in refused["detail"]
            assert robot.received(MoveJoints) == []


def test_two_starts_with_one_key_at_the_same_time_are_one_action(
    cloud: Cloud, anna: Person, robot: Robot, memory: Memory
) -> None:
    del cloud
    batch = memory.tables.batch
    before: list[str] = []

    async def overtaken(table: str, writes: Any) -> Any:
        with mock.patch.object(memory.tables, "batch", batch):
            if not before:
                # What the other start writes: the same rows with another action.
                rows = await batch(table, writes)
                before.append(rows[0].data["id"])
                raise Conflict("changed concurrently")
            return await batch(table, writes)

    with mock.patch.object(memory.tables, "batch", overtaken):
        action = anna.start(robot.device, idempotency_key="k", wait_ms=0).json()
    assert [action["id"]] == before
    assert robot.received(MoveJoints) == [], "the other start publishes it"
    rows = control_rows(robot.cloud, robot.device)
    assert [key for key in rows if key.startswith("action:")] == [f"action:{action['id'].rpartition('-')[2]}"]


def test_a_new_action_advances_a_queue_that_a_killed_process_left(
    cloud: Cloud, anna: Person, robot: Robot, running: str
) -> None:
    first = queued(anna, robot.device)
    end_silently(cloud, running)
    second = anna.start(robot.device, **QUEUE, wait_ms=0).json()["id"]
    assert sent(robot) == [running, first]
    robot.report(first, AckStatus.DONE)
    assert sent(robot) == [running, first, second]


def test_nobody_queues_behind_the_lease_of_another_person(
    cloud: Cloud, anna: Person, robot: Robot, running: str
) -> None:
    bert = cloud.sign_in("bert")
    share(anna, f"devices/{robot.device}", bert, "operator")
    other = bert.start(robot.device, **QUEUE)
    assert (other.status_code, other.json()["status"]) == (202, "queued"), "behind the action's own lease"
    assert anna.take_lease(robot.device).status_code in {200, 201}
    refused = problem(bert.start(robot.device, **QUEUE), 409, "lease-held")
    assert refused["holder"] == "anna"
    assert anna.start(robot.device, **QUEUE).status_code == 202, "behind a lease of their own"
    assert sent(robot) == [running]
