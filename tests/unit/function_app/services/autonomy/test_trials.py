"""Trials of tasks: how they are sent, and what is stored about them."""

import secrets
from typing import Any

import pytest

from device_agent.protocol import MAX_SEED, AckStatus, Reason, RunTrial
from device_agent.protocol.manifests import tasks
from device_agent.protocol.manifests.shipped import ROBOTS
from function_app.domain.actions.action import LOST
from function_app.domain.actions.trials import Trial
from function_app.domain.identity.accounts import Identity
from function_app.services.actions import trial_log
from function_app.services.actions.tasks import RobotTypeTasks
from function_app.services.actions.trial_log import KEEP_MS
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.unit.function_app.services.actions.queue_requests import pass_time
from tests.unit.function_app.services.autonomy.trials_fixture import (
    DAY_S,
    SUCCESS,
    TASK,
    begin,
    finish,
    gripper,
    partition_of,
    report,
    rows,
    trials,
)
from tests.unit.function_app.services.sharing.shares import share, unshare


@pytest.fixture
def robot(cloud: Cloud, anna: Person) -> Robot:
    """A connected robot with tasks, without a monitor: the test reports the verdicts."""
    return gripper(cloud, anna)


def test_a_trial_sends_the_movement_of_the_task_with_the_seed(anna: Person, robot: Robot) -> None:
    action = begin(anna, robot)
    (command,) = robot.received(RunTrial)
    request = command.request
    assert isinstance(request, RunTrial)
    manifest = tasks.load(ROBOTS / "ur5_gripper" / "scene.xml")
    assert manifest is not None
    assert (request.name, request.seed, request.tasks_sha256) == (TASK, 7, manifest.sha256)
    assert request.movement.name == "pick_and_place"
    assert request.movement.parameters["object"] == "red_cube"
    assert action["request"]["movement"] == "pick_and_place"


def test_a_trial_without_a_seed_gets_a_random_one(anna: Person, robot: Robot) -> None:
    action = begin(anna, robot, seed=None)
    (command,) = robot.received(RunTrial)
    assert isinstance(command.request, RunTrial)
    assert command.request.seed is not None
    assert action["request"]["seed"] == command.request.seed


def test_a_random_seed_may_be_the_highest(anna: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(secrets, "randbelow", lambda end: end - 1)
    assert begin(anna, robot, seed=None)["request"]["seed"] == MAX_SEED


def test_a_repeated_command_of_a_trial_is_identical(cloud: Cloud, anna: Person, robot: Robot) -> None:
    robot.silent = True
    action = begin(anna, robot, wait_ms=0)
    pass_time(cloud, 2)
    first, second = robot.payloads[action["id"]][:2]
    assert first == second


def test_a_success_is_stored_with_its_circumstances(cloud: Cloud, anna: Person, robot: Robot) -> None:
    action = begin(anna, robot)
    pass_time(cloud, 2)
    (running,) = trials(anna)
    assert (running["state"], running["ended_at"], running["duration_s"]) == ("running", None, None)
    finish(anna, robot, action["id"], SUCCESS)
    (trial,) = trials(anna)
    assert (trial["state"], trial["cause"], trial["duration_s"], trial["seed"]) == ("success", "", 12.5, 7)
    assert (trial["action"], trial["device"], trial["epoch"]) == (action["id"], robot.device, action["epoch"])
    assert (trial["caller"], trial["software"], trial["type_version"]) == ("anna", "1.2", 3)
    assert (trial["movement"], trial["simulated"]) == ("pick_and_place", True)
    (command,) = robot.received(RunTrial)
    assert isinstance(command.request, RunTrial)
    (row,) = rows(cloud, robot)
    assert records.read(row, Trial).tasks_sha256 == command.request.tasks_sha256
    assert trial["ended_at"] >= trial["started_at"]


@pytest.mark.parametrize("status", [AckStatus.DONE, AckStatus.FAILED])
def test_only_the_verdict_of_the_monitor_counts(anna: Person, robot: Robot, status: AckStatus) -> None:
    action = begin(anna, robot)
    finish(anna, robot, action["id"], {"verdict": "failed", "cause": "incomplete", "detail": "it fell"}, status)
    (trial,) = trials(anna)
    assert (trial["state"], trial["cause"], trial["detail"]) == ("failed", "incomplete", "it fell")
    rate = report(anna)["rate"]
    assert (rate["trials"], rate["successes"]) == (1, 0)


@pytest.mark.parametrize("claim", [None, "success", {"verdict": "won"}, {"cause": "time_limit"}])
def test_an_end_without_a_valid_verdict_is_unknown(anna: Person, robot: Robot, claim: Any) -> None:
    action = begin(anna, robot)
    finish(anna, robot, action["id"], claim)
    (trial,) = trials(anna)
    assert (trial["state"], trial["cause"]) == ("unknown", "lost")
    assert trial["ended_at"] >= trial["started_at"]
    assert trial["detail"] == trial_log.NOT_REPORTED
    rate = report(anna)["rate"]
    assert (rate["trials"], rate["unknown"], rate["rate"]) == (0, 1, None)


def test_a_lost_link_makes_a_trial_unknown_until_the_device_reports(cloud: Cloud, anna: Person, robot: Robot) -> None:
    action = begin(anna, robot, timeout_ms=80_000)
    robot.silent = True
    pass_time(cloud, 100)
    (trial,) = trials(anna)
    assert (trial["state"], trial["cause"]) == ("unknown", "lost")
    finish(anna, robot, action["id"], SUCCESS)
    assert [each["state"] for each in trials(anna)] == ["success"]


def test_a_verdict_before_the_end_of_the_action_does_not_count(cloud: Cloud, anna: Person, robot: Robot) -> None:
    robot.reports = lambda command: (robot.ack(command.id, AckStatus.RECEIVED, result={"trial": SUCCESS}),)
    begin(anna, robot, timeout_ms=80_000, wait_ms=0)
    pass_time(cloud, 2)
    assert trials(anna) == []
    pass_time(cloud, 100)
    assert [each["state"] for each in trials(anna)] == ["unknown"]


def test_a_trial_that_the_device_rejected_did_not_happen(cloud: Cloud, anna: Person, robot: Robot) -> None:
    robot.reports = lambda command: (
        robot.ack(command.id, AckStatus.FAILED, reason=Reason(code="tasks_differ", message="x")),
    )
    begin(anna, robot)
    pass_time(cloud, 2)
    assert trials(anna) == []


def test_a_rejection_after_an_unknown_outcome_removes_the_trial(cloud: Cloud, anna: Person, robot: Robot) -> None:
    robot.silent = True
    action = begin(anna, robot, wait_ms=0, ttl_ms=1_000)
    pass_time(cloud, 20)
    assert [each["state"] for each in trials(anna)] == ["unknown"]
    robot.fail(action["id"], "expired", "it arrived late")
    anna.action(action["id"], wait_ms=20_000)
    assert trials(anna) == []


def test_a_trial_that_was_never_reported_stays_unknown(cloud: Cloud, anna: Person, robot: Robot) -> None:
    action = begin(anna, robot)
    robot.silent = True
    pass_time(cloud, 320)
    pass_time(cloud, 8 * DAY_S, step_s=DAY_S / 2)
    anna = cloud.sign_in("anna")
    assert anna.action(action["id"])["reason"]["code"] == LOST
    assert [(each["state"], each["cause"]) for each in trials(anna)] == [("unknown", "lost")]


def test_a_short_time_limit_of_the_action_is_rejected(anna: Person, robot: Robot) -> None:
    answer = anna.start(
        robot.device, request={"kind": "run_trial", "name": TASK, "seed": 1}, timeout_ms=74_999, wait_ms=0
    )
    problem(answer, 422, "invalid")
    assert "75000" in answer.json()["detail"]
    begin(anna, robot, timeout_ms=75_000)


def test_a_trial_is_the_task_of_the_devices_owner(
    anna: Person, bert: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    owners: list[str] = []
    get = RobotTypeTasks.get

    async def recorded(tasks: RobotTypeTasks, caller: Identity, *task: str) -> Any:
        owners.append(caller.account)
        return await get(tasks, caller, *task)

    monkeypatch.setattr(RobotTypeTasks, "get", recorded)
    share(anna, f"devices/{robot.device}", bert, "operator")
    begin(bert, robot)
    assert owners == [anna.account]


def test_a_trial_is_unknown_as_soon_as_its_account_loses_the_device(anna: Person, bert: Person, robot: Robot) -> None:
    share(anna, f"devices/{robot.device}", bert, "operator")
    begin(bert, robot)
    assert [each["state"] for each in trials(anna)] == []
    unshare(anna, f"devices/{robot.device}", bert)
    assert [each["state"] for each in trials(anna)] == ["unknown"]


def test_the_deletion_of_a_trial_is_scheduled_once(
    cloud: Cloud, anna: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    retention = cloud.functions.trial_log._retention
    delete_row_at, calls = retention.delete_row_at, []

    async def recorded(table: str, partition: str, key: str, *, due_ms: int) -> None:
        calls.append((table, partition, key, due_ms))
        await delete_row_at(table, partition, key, due_ms=due_ms)

    monkeypatch.setattr(retention, "delete_row_at", recorded)
    action = begin(anna, robot)
    pass_time(cloud, 2)
    assert [each["state"] for each in trials(anna)] == ["running"]
    finish(anna, robot, action["id"], SUCCESS)
    (row,) = rows(cloud, robot)
    trial = records.read(row, Trial)
    due_ms = trial.started_ms + KEEP_MS
    assert trial.expires_ms == due_ms
    assert [call for call in calls if call[0] == records.TRIALS] == [(records.TRIALS, row.partition, row.key, due_ms)]


def test_trials_are_deleted_with_the_pairing(cloud: Cloud, anna: Person, robot: Robot) -> None:
    finish(anna, robot, begin(anna, robot)["id"], SUCCESS)
    partition = partition_of(cloud, robot)
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    pass_time(cloud, 3_700)
    assert cloud.run(cloud.functions.tables.query(records.TRIALS, partition)).rows == ()


def test_a_trial_is_stored_when_the_process_was_killed_before(cloud: Cloud, anna: Person, robot: Robot) -> None:
    action = begin(anna, robot)
    finish(anna, robot, action["id"], SUCCESS)
    (row,) = rows(cloud, robot)
    cloud.run(cloud.functions.tables.delete(records.TRIALS, row))
    pass_time(cloud, 320)
    assert [each["state"] for each in trials(anna)] == ["success"]
