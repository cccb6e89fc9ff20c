"""Lists of tasks and trials, success rates, and published batches."""

from datetime import datetime
from typing import Any

import pytest

from function_app.domain.actions.trials import TrialBatch
from function_app.services.actions import trial_log
from function_app.services.actions.trial_log import KEEP_MS
from function_app.services.autonomy import task_reports
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.unit.function_app.services.actions.queue_requests import pass_time
from tests.unit.function_app.services.autonomy.trials_fixture import (
    DAY_S,
    HASH,
    SUCCESS,
    TASK,
    TASKS,
    TRIALS,
    begin,
    count_reads,
    finish,
    gripper,
    plant_copies,
    report,
    trials,
)
from tests.unit.function_app.services.sharing.shares import share, unshare

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


@pytest.fixture
def robot(cloud: Cloud, anna: Person) -> Robot:
    """A connected robot with tasks, without a monitor: the test reports the verdicts."""
    return gripper(cloud, anna)


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


def test_a_batch_whose_numbers_contradict_each_other_is_rejected(anna: Person) -> None:
    answer = anna.post(f"{TASKS}/{TASK}/batches", BATCH | {"successes": 10})
    problem(answer, 422, "invalid")
