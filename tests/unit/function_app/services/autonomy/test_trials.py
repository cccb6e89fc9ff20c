"""Trials of tasks: what is stored about them, and their success rates."""

import secrets
from dataclasses import replace
from datetime import datetime
from typing import Any

import pytest

from device_agent.protocol import MAX_SEED, AckStatus, Reason, RunTrial
from device_agent.protocol.manifests import tasks
from device_agent.protocol.manifests.shipped import ROBOTS
from function_app.domain.actions.action import LOST
from function_app.domain.actions.trials import Trial, TrialBatch
from function_app.domain.identity.accounts import Identity
from function_app.ports.tables import Row
from function_app.services.actions import trial_log
from function_app.services.actions.tasks import RobotTypeTasks
from function_app.services.actions.trial_log import KEEP_MS
from function_app.services.autonomy import task_reports
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.unit.function_app.services.actions.queue_requests import pass_time
from tests.unit.function_app.services.sharing.shares import share, unshare

TASK = "red_cube_in_green_tray"
TASKS = "/robot-types/ur5_gripper/tasks"
TRIALS = f"{TASKS}/{TASK}/trials"
HASH = "0" * 64
DAY_S = 86_400
SUCCESS = {"verdict": "success", "duration_s": 12.5, "simulated": True, "software": "1.2", "type_version": 3}
BATCH: dict[str, Any] = {
    "first_seed": 5,
    "trials": 10,
    "successes": 9,
    "causes": {"time_limit": 1},
    "tasks_sha256": HASH,
    "movement_sha256": HASH,
    "software": "1.2",
    "type_version": 3,
}


def gripper(cloud: Cloud, owner: Person) -> Robot:
    robot = cloud.robot()
    robot.robot_type = "ur5_gripper"
    robot.pair(owner)
    return robot.connect()


@pytest.fixture
def robot(cloud: Cloud, anna: Person) -> Robot:
    """A connected robot with tasks, without a monitor: the test reports the verdicts."""
    return gripper(cloud, anna)


def begin(
    person: Person, robot: Robot, *, seed: int | None = 7, wait_ms: int = 10_000, **options: Any
) -> dict[str, Any]:
    """Start a trial; returns its action."""
    answer = person.start(
        robot.device, request={"kind": "run_trial", "name": TASK, "seed": seed}, wait_ms=wait_ms, **options
    )
    assert answer.status_code in {200, 202}, answer.text
    action: dict[str, Any] = answer.json()
    return action


def finish(person: Person, robot: Robot, action: str, trial: Any, status: AckStatus = AckStatus.DONE) -> None:
    """Report the end of the action with the verdict of the monitor."""
    robot.report(action, status, result={"trial": trial})
    assert person.action(action, wait_ms=20_000)["status"] == status.value


def trials(person: Person, **query: Any) -> list[dict[str, Any]]:
    return person.pages(TRIALS, **query)


def report(person: Person) -> dict[str, Any]:
    answer = person.get(f"{TASKS}/{TASK}")
    assert answer.status_code == 200, answer.text
    body: dict[str, Any] = answer.json()
    return body


def test_the_tasks_of_a_type_are_listed_as_the_manifest_declares_them(anna: Person) -> None:
    items = anna.get(TASKS).json()["items"]
    (item,) = [each for each in items if each["name"] == TASK]
    success = {"object": "red_cube", "region": "green_tray", "rest_s": 1.0, "lifted_m": 0.05}
    assert success.items() <= item["success"].items()
    assert (item["observed"], item["resets"], item["movement"]) == ("simulation", True, "pick_and_place")
    assert item["rate"] == {"trials": 0, "successes": 0, "unknown": 0, "rate": None, "lower": 0, "upper": 1}
    assert anna.get("/robot-types/ur5/tasks").json() == {"items": []}
    problem(anna.get("/robot-types/none/tasks"), 404, "robot-type-unknown")
    for path in (f"{TASKS}/none", f"{TASKS}/none/trials"):
        problem(anna.get(path), 404, "task-unknown")


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


def test_rates_are_grouped_by_device_version_and_day(cloud: Cloud, anna: Person, robot: Robot) -> None:
    other = gripper(cloud, anna)
    results = [
        (robot, SUCCESS),
        (robot, SUCCESS | {"type_version": 4}),
        (other, {"verdict": "failed", "cause": "stopped"}),
    ]
    for index, (each, trial) in enumerate(results):
        finish(anna, each, begin(anna, each, seed=index)["id"], trial)
        cloud.clock.advance(1)
    body = report(anna)
    assert (body["rate"]["trials"], body["rate"]["successes"]) == (3, 2)
    assert body["rate"]["lower"] == pytest.approx(0.2077, abs=1e-4)
    assert body["rate"]["upper"] == pytest.approx(0.9385, abs=1e-4)
    by_device = {item["device"]: item["rate"]["successes"] for item in body["devices"]}
    assert by_device == {robot.device: 2, other.device: 0}
    assert [(item["type_version"], item["rate"]["trials"]) for item in body["versions"]] == [(None, 1), (3, 1), (4, 1)]
    assert sum(day["rate"]["trials"] for day in body["days"]) == 3
    assert body["complete"]
    assert next(each["rate"] for each in anna.get(TASKS).json()["items"] if each["name"] == TASK) == body["rate"]


def test_trials_are_listed_in_pages_across_devices_and_filtered(cloud: Cloud, anna: Person, robot: Robot) -> None:
    other = gripper(cloud, anna)
    for seed in range(5):
        each = (robot, other)[seed % 2]
        trial = SUCCESS if seed else {"verdict": "failed", "cause": "time_limit"}
        finish(anna, each, begin(anna, each, seed=seed)["id"], trial)
        cloud.clock.advance(1)
    assert [trial["seed"] for trial in trials(anna, limit=2)] == [4, 3, 2, 1, 0]
    assert [trial["seed"] for trial in trials(anna, limit=2, device=other.device)] == [3, 1]
    assert [trial["seed"] for trial in trials(anna, limit=1, state="failed")] == [0]
    problem(anna.get(TRIALS, params={"cursor": "a/b"}), 422, "cursor-invalid")
    problem(anna.get(TRIALS, params={"device": "none"}), 404, "device-unknown")


def test_a_rare_filter_with_a_small_limit_reads_few_pages(
    cloud: Cloud, anna: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    finish(anna, robot, begin(anna, robot)["id"], SUCCESS)
    plant_copies(cloud, robot, 1_200)
    sizes = count_reads(cloud, monkeypatch)
    assert anna.get(TRIALS, params={"state": "unknown", "limit": 1}).json()["items"] == []
    assert sizes == [task_reports.READ_SIZE] * 2


def test_a_report_asks_for_no_more_rows_than_it_evaluates(
    cloud: Cloud, anna: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    finish(anna, robot, begin(anna, robot)["id"], SUCCESS)
    plant_copies(cloud, robot, 1_200)
    monkeypatch.setattr(task_reports, "MAX_TRIALS", 1_050)
    sizes = count_reads(cloud, monkeypatch)
    body = report(anna)
    assert (body["rate"]["trials"], body["complete"]) == (1_050, False)
    assert [size for size in sizes if size != task_reports.MAX_BATCHES] == [1_000, 51]


def test_more_trials_than_one_query_returns_are_read_once(
    cloud: Cloud, anna: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    finish(anna, robot, begin(anna, robot)["id"], SUCCESS)
    plant_copies(cloud, robot, 6)
    monkeypatch.setattr(trial_log, "_MAX_PAGE", 2)
    device = cloud.run(cloud.functions.devices.get_as_owner(robot.device))
    assert device is not None
    log = cloud.functions.trial_log
    found = cloud.run(log.read([device], limit=10))
    keys = [trial_log.key_of(trial) for trial in found]
    assert len(set(keys)) == len(keys) == 7
    assert cloud.run(log.read([device], after=keys[2], limit=3)) == found[3:6]


def test_older_trials_are_left_out_of_a_report_that_says_so(
    cloud: Cloud, anna: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(task_reports, "MAX_TRIALS", 1)
    for seed in range(2):
        finish(anna, robot, begin(anna, robot, seed=seed)["id"], SUCCESS)
        cloud.clock.advance(1)
    body = report(anna)
    assert (body["rate"]["trials"], body["complete"]) == (1, False)


def test_a_viewer_sees_trials_of_a_shared_device_only_while_it_is_shared(
    anna: Person, bert: Person, robot: Robot
) -> None:
    finish(anna, robot, begin(anna, robot)["id"], SUCCESS)
    assert trials(bert) == []
    share(anna, f"devices/{robot.device}", bert, "viewer")
    assert [trial["seed"] for trial in trials(bert)] == [7]
    unshare(anna, f"devices/{robot.device}", bert)
    assert report(bert)["rate"]["trials"] == 0


def test_a_trial_is_unknown_as_soon_as_its_account_loses_the_device(anna: Person, bert: Person, robot: Robot) -> None:
    share(anna, f"devices/{robot.device}", bert, "operator")
    begin(bert, robot)
    assert [each["state"] for each in trials(anna)] == []
    unshare(anna, f"devices/{robot.device}", bert)
    assert [each["state"] for each in trials(anna)] == ["unknown"]


def test_a_published_batch_is_shown_apart_from_trials_of_devices(anna: Person, bert: Person) -> None:
    answer = anna.post(f"{TASKS}/{TASK}/batches", BATCH)
    assert answer.status_code == 201, answer.text
    body = report(anna)
    (batch,) = body["batches"]
    assert (batch["rate"]["rate"], batch["causes"], batch["published_by"]) == (0.9, {"time_limit": 1}, "anna")
    assert body["rate"]["trials"] == 0
    assert report(bert)["batches"] == []
    for other in ("blue_cube_in_green_tray", "yellow_block_in_green_tray"):
        assert anna.get(f"{TASKS}/{other}").json()["batches"] == []


def test_a_batch_is_stored_for_two_years(cloud: Cloud, anna: Person) -> None:
    anna.post(f"{TASKS}/{TASK}/batches", BATCH)
    published_ms = cloud.clock.now_ms()
    (batch,) = report(anna)["batches"]
    assert datetime.fromisoformat(batch["published_at"]).timestamp() * 1000 == pytest.approx(published_ms, abs=1000)
    partition = f"batches/{anna.account}/ur5_gripper"
    (row,) = cloud.run(cloud.functions.tables.query(records.TRIALS, partition)).rows
    assert records.read(row, TrialBatch).expires_ms == pytest.approx(published_ms + KEEP_MS, abs=1000)
    pass_time(cloud, 729 * DAY_S, step_s=729 * DAY_S)
    assert cloud.run(cloud.functions.tables.query(records.TRIALS, partition)).rows == (row,)
    pass_time(cloud, 2 * DAY_S, step_s=DAY_S)
    assert cloud.run(cloud.functions.tables.query(records.TRIALS, partition)).rows == ()


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


def test_a_batch_whose_numbers_contradict_each_other_is_rejected(anna: Person) -> None:
    answer = anna.post(f"{TASKS}/{TASK}/batches", BATCH | {"successes": 10})
    problem(answer, 422, "invalid")


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


def partition_of(cloud: Cloud, robot: Robot) -> str:
    device = cloud.run(cloud.functions.devices.get_as_owner(robot.device))
    assert device is not None
    return f"{robot.device}/{device.pairing}"


def rows(cloud: Cloud, robot: Robot) -> tuple[Any, ...]:
    return tuple(cloud.run(cloud.functions.tables.query(records.TRIALS, partition_of(cloud, robot))).rows)


def plant_copies(cloud: Cloud, robot: Robot, count: int) -> None:
    """Store older copies of the robot's only trial."""
    (row,) = rows(cloud, robot)
    trial = records.read(row, Trial)
    for index in range(count):
        key = f"{row.key}{index:04}"
        copy = records.to_data(replace(trial, action=key))
        cloud.run(cloud.functions.tables.create(records.TRIALS, Row(row.partition, key, copy)))


def count_reads(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The page size of each query of the table of trials from now on."""
    sizes: list[int] = []
    query = cloud.functions.tables.query

    async def counted(table: str, partition: str, **options: Any) -> Any:
        if table == records.TRIALS:
            sizes.append(options["limit"])
        return await query(table, partition, **options)

    monkeypatch.setattr(cloud.functions.tables, "query", counted)
    return sizes
