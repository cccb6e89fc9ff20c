"""A queue advances after a killed process or a concurrent write left it as it was."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest import mock

import pytest

from device_agent.protocol import AckStatus, Mode, RunMovement, State
from function_app.domain.actions.action import RETRY_MS, Action, Status, end
from function_app.domain.actions.queue import UNPAIRED
from function_app.domain.common.problems import Problem
from function_app.ports.tables import Conflict
from function_app.services.actions.dispatcher import PermissionEnded
from function_app.services.actions.queue import CHECK_MS
from function_app.services.devices.control_rows import read_control_rows
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.cloud.memory import Memory
from tests.unit.function_app.services.actions.queue_requests import (
    control_rows,
    pass_time,
    queued,
    reason,
    reminders,
    sent,
    started,
)
from tests.unit.function_app.services.sharing.shares import share

MISSING = "00000000000000000000"


@contextmanager
def one_conflict(memory: Memory) -> Iterator[None]:
    """Another process changes the rows before the next batch."""
    batch = memory.tables.batch
    conflicts = [Conflict("changed concurrently")]

    async def conflicting(*arguments: Any) -> Any:
        if conflicts:
            raise conflicts.pop()
        return await batch(*arguments)

    with mock.patch.object(memory.tables, "batch", conflicting):
        yield
    assert not conflicts


def end_silently(cloud: Cloud, action: str, status: Status = Status.DONE) -> None:
    """End an action like a process that is killed before it advances the queue."""
    now_ms = cloud.clock.now_ms()
    cloud.run(cloud.functions.action_store.change(action, lambda stored: end(stored, status, "x", "x", now_ms)))


def change_queue(cloud: Cloud, device: str, **fields: Any) -> None:
    tables = cloud.functions.tables
    row = cloud.run(tables.get(records.CONTROL, device, "now:queue"))
    assert row is not None
    cloud.run(tables.replace(records.CONTROL, row.changed({**row.data, **fields})))


def check(cloud: Cloud, device: str) -> bool:
    return cloud.run(cloud.functions.queues.check(device))


def test_a_check_starts_the_next_action_after_a_killed_process(
    cloud: Cloud, anna: Person, robot: Robot, running: str
) -> None:
    first, second = queued(anna, robot.device), queued(anna, robot.device)
    assert check(cloud, robot.device) is True
    assert sent(robot) == [running]
    end_silently(cloud, running)
    assert check(cloud, robot.device) is True, "the second action still waits"
    assert sent(robot) == [running, first]
    end_silently(cloud, first)
    assert check(cloud, robot.device) is False
    assert sent(robot) == [running, first, second]


@pytest.mark.parametrize("status", [Status.FAILED, Status.UNKNOWN])
def test_a_check_ends_cancelled_actions_after_a_killed_process(
    cloud: Cloud, anna: Person, robot: Robot, running: str, status: Status
) -> None:
    waiting = [queued(anna, robot.device) for _ in range(2)]
    end_silently(cloud, running, status)
    code = f"earlier-{status.value}"
    assert control_rows(cloud, robot.device)["now:queue"]["dropped"] == dict.fromkeys(waiting, code)
    assert check(cloud, robot.device) is False
    assert {reason(anna, action) for action in waiting} == {("cancelled", code)}


def test_places_of_actions_that_do_not_wait_are_removed(cloud: Cloud, anna: Person, robot: Robot, running: str) -> None:
    waiting = queued(anna, robot.device)
    missing = f"{robot.device}-{MISSING}"
    change_queue(cloud, robot.device, dropped={missing: "stopped", running: "stopped"}, actions=[missing, waiting])
    assert check(cloud, robot.device) is True
    assert anna.action(running)["status"] == "started", "it has left the queue, so it is not cancelled"
    assert control_rows(cloud, robot.device)["now:queue"]["dropped"] == {}
    robot.report(running, AckStatus.DONE)
    assert started(anna, waiting)
    assert control_rows(cloud, robot.device)["now:queue"]["actions"] == []


@pytest.mark.parametrize(
    ("signed_out", "expected"), [(False, ("expired", "queue-timeout")), (True, ("failed", "signed-out"))]
)
def test_an_action_that_cannot_start_is_ended_despite_a_concurrent_write(
    cloud: Cloud, anna: Person, robot: Robot, memory: Memory, running: str, *, signed_out: bool, expected: Any
) -> None:
    elsewhere = cloud.sign_in("anna")
    waiting = queued(elsewhere, robot.device, queue_ms=10_000)
    end_silently(cloud, running)
    if signed_out:
        elsewhere.post("/auth/sign-out")
    else:
        cloud.clock.advance(20)
    with one_conflict(memory):
        assert check(cloud, robot.device) is False
    assert reason(anna, waiting) == expected
    assert sent(robot) == [running]


def test_the_next_action_starts_once_despite_a_concurrent_write(
    cloud: Cloud, anna: Person, robot: Robot, memory: Memory, running: str
) -> None:
    waiting = queued(anna, robot.device)
    end_silently(cloud, running)
    with one_conflict(memory):
        check(cloud, robot.device)
    assert sent(robot) == [running, waiting]


def test_requests_and_acks_are_stored_despite_a_concurrent_write(
    cloud: Cloud, anna: Person, robot: Robot, memory: Memory
) -> None:
    with one_conflict(memory):
        action = anna.start(robot.device, wait_ms=10_000).json()
    assert action["status"] == "started"
    waiting = queued(anna, robot.device)
    with one_conflict(memory):
        assert anna.post(f"/actions/{waiting}/cancel").json()["status"] == "cancelled"
    with one_conflict(memory):
        assert anna.post(f"/actions/{action['id']}/cancel").status_code == 202
    with one_conflict(memory):
        robot.report(action["id"], AckStatus.CANCELLED)
    assert anna.action(action["id"])["status"] == "cancelled"
    assert cloud.run(read_control_rows(cloud.functions.tables, robot.device)).action == ""


def test_an_action_is_started_in_the_last_moment_of_its_queueing_time_only(
    cloud: Cloud, anna: Person, robot: Robot, running: str
) -> None:
    late, last = (queued(anna, robot.device) for _ in range(2))
    end_silently(cloud, running)
    rows = control_rows(cloud, robot.device)
    until_ms = rows[f"action:{late.rpartition('-')[2]}"]["queued_until_ms"]
    assert rows[f"action:{last.rpartition('-')[2]}"]["queued_until_ms"] > until_ms
    with mock.patch.object(cloud.clock, "now_ms", return_value=until_ms):
        cloud.run(cloud.functions.queues.advance(robot.device))
    assert sent(robot) == [running, last]
    assert reason(anna, late) == ("expired", "queue-timeout")


def test_a_started_action_occupies_slot_and_lease_and_leaves_the_queue(
    cloud: Cloud, anna: Person, robot: Robot, running: str
) -> None:
    elsewhere = cloud.sign_in("anna")
    waiting = queued(anna, robot.device)
    robot.report(running, AckStatus.DONE)
    rows = control_rows(cloud, robot.device)
    assert (rows["now:slot"]["action"], rows["now:queue"]["actions"]) == (waiting, [])
    assert problem(anna.start(robot.device), 409, "device-busy")["action"] == waiting
    problem(elsewhere.take_lease(robot.device), 409, "lease-held")
    assert rows["now:lease"]["action"] == waiting
    assert rows["now:lease"]["epoch"] == anna.action(waiting)["epoch"]
    taken = rows[f"event:control-taken-{rows['now:lease']['epoch']}"]
    assert (taken["owner"], taken["by"]["account"], taken["event"]["data"]["action"]) == (
        anna.account,
        anna.account,
        waiting,
    )


def test_the_timer_publishes_a_started_action_that_the_broker_did_not_confirm(
    cloud: Cloud, anna: Person, robot: Robot, broker: MemoryBroker, running: str
) -> None:
    waiting = queued(anna, robot.device)
    pass_time(cloud, 3)
    end_silently(cloud, running)
    broker.reachable = False
    check(cloud, robot.device)
    broker.reachable = True
    cloud.sweep()
    assert sent(robot) == [running], "not before it is due"
    pass_time(cloud, RETRY_MS / 1000 + 0.1)
    assert sent(robot) == [running, waiting]


def test_an_action_that_a_stop_cancels_meanwhile_does_not_start(
    cloud: Cloud, anna: Person, robot: Robot, running: str
) -> None:
    waiting = queued(anna, robot.device)
    end_silently(cloud, running)
    dispatcher = cloud.functions.queues._dispatcher
    permissions = dispatcher.current_permissions

    async def stopped(action: Action) -> Any:
        control = await read_control_rows(cloud.functions.tables, robot.device)
        if control.queue.actions:
            queue = control.queue.with_all_cancelled("stopped")
            await cloud.functions.tables.batch(records.CONTROL, [control.write_queue(robot.device, queue)])
        return await permissions(action)

    with mock.patch.object(dispatcher, "current_permissions", stopped):
        check(cloud, robot.device)
    check(cloud, robot.device)
    assert sent(robot) == [running]
    assert reason(anna, waiting) == ("cancelled", "stopped")


def test_a_lease_that_the_device_has_ended_does_not_stop_the_queue(
    cloud: Cloud, anna: Person, robot: Robot, running: str
) -> None:
    waiting = queued(cloud.sign_in("anna"), robot.device)
    epoch = anna.take_lease(robot.device).json()["epoch"]
    now_ms = cloud.clock.now_ms()
    state = State(device="arm", at_ms=now_ms, tick_ms=1, mode=Mode.IDLE, epoch=epoch, ended_epoch=epoch)
    robot.publish_state(state)
    robot.report(running, AckStatus.DONE)
    assert started(anna, waiting)
    assert anna.action(waiting)["epoch"] == epoch + 1


@pytest.mark.parametrize("first", ["missing", "ended"])
def test_a_first_place_without_a_waiting_action_is_removed(
    cloud: Cloud, anna: Person, robot: Robot, running: str, first: str
) -> None:
    waiting = queued(anna, robot.device)
    end_silently(cloud, running)
    stale = running if first == "ended" else f"{robot.device}-{MISSING}"
    change_queue(cloud, robot.device, actions=[stale, waiting])
    assert check(cloud, robot.device) is False
    assert sent(robot) == [running, waiting]
    assert control_rows(cloud, robot.device)["now:queue"]["actions"] == []


def test_a_queued_movement_is_sent_with_its_parameters(anna: Person, robot: Robot, running: str) -> None:
    assert anna.put("/robot-types/ur5/movements/mine", {"source": "robot.home()"}).status_code == 201
    request = {"kind": "run_movement", "name": "mine", "parameters": {"note": "x", "list": [1, 2.5]}}
    waiting = queued(anna, robot.device, request=request)
    robot.report(running, AckStatus.DONE)
    (command,) = robot.received(RunMovement)
    assert isinstance(command.request, RunMovement)
    assert (command.id, command.request.parameters) == (waiting, request["parameters"])


def test_a_queued_movement_of_the_owner_is_sent_for_another_operator(
    cloud: Cloud, anna: Person, robot: Robot, running: str
) -> None:
    assert anna.put("/robot-types/ur5/movements/mine", {"source": "robot.home()"}).status_code == 201
    bert = cloud.sign_in("bert")
    share(anna, f"devices/{robot.device}", bert, "operator")
    waiting = queued(bert, robot.device, request={"kind": "run_movement", "name": "mine"})
    robot.report(running, AckStatus.DONE)
    (command,) = robot.received(RunMovement)
    assert isinstance(command.request, RunMovement)
    assert (command.id, command.request.author, command.caller) == (waiting, anna.account, "bert")


def test_a_check_is_due_after_the_queue_is_written(cloud: Cloud, robot: Robot) -> None:
    """A reminder that is due before is deleted, because the queue is empty; nothing would advance the queue."""
    now_ms = cloud.clock.now_ms()
    cloud.run(cloud.functions.queues.schedule_check(robot.device))
    assert reminders(cloud) == [f"{now_ms + 1 + CHECK_MS:013d}:queue:{robot.device}"]


def test_permission_ends_with_the_pairing(cloud: Cloud, anna: Person, robot: Robot, running: str) -> None:
    del anna, robot
    stored = cloud.run(cloud.functions.action_store.get(running))
    assert stored is not None
    dispatcher = cloud.functions.queues._dispatcher
    with pytest.raises(PermissionEnded, match=r"The device was un-paired before it ended\.") as ended:
        cloud.run(dispatcher.current_permissions(replace(stored.action, pairing="another")))
    assert ended.value.why == UNPAIRED


def test_an_action_that_lost_its_lease_ends_with_a_recorded_rejection(anna: Person, robot: Robot, running: str) -> None:
    epoch = anna.take_lease(robot.device).json()["epoch"]
    waiting = queued(anna, robot.device, epoch=epoch)
    anna.take_lease(robot.device)
    robot.report(running, AckStatus.DONE)
    assert reason(anna, waiting) == ("failed", "lease-lost")
    events = anna.get(f"/devices/{robot.device}/events").json()["items"]
    wanted = [event["data"]["wanted"] for event in events if event["kind"] == "command-rejected"]
    assert wanted == ["start a queued action"]


def test_the_end_of_an_earlier_lease_is_recorded_when_the_next_action_starts(
    cloud: Cloud, anna: Person, robot: Robot, running: str
) -> None:
    waiting = queued(anna, robot.device)
    epoch = anna.take_lease(robot.device, lease_ms=1_000).json()["epoch"]
    cloud.clock.advance(2)
    end_silently(cloud, running)
    check(cloud, robot.device)
    assert sent(robot) == [running, waiting]
    assert f"event:control-expired-{epoch}" in control_rows(cloud, robot.device)


def test_an_action_stays_queued_while_its_rows_are_busy(cloud: Cloud, anna: Person, robot: Robot, running: str) -> None:
    waiting = queued(anna, robot.device)
    end_silently(cloud, running)
    busy = Problem("busy", 503, "Busy", "The rows change all the time.")
    with mock.patch.object(cloud.functions.queues, "_start", side_effect=busy):
        check(cloud, robot.device)
    assert anna.action(waiting)["status"] == "queued"
    check(cloud, robot.device)
    assert sent(robot) == [running, waiting]
