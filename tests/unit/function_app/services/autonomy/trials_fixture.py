"""Starts and ends trials of tasks, and reads what is stored about them."""

from dataclasses import replace
from typing import Any

import pytest

from device_agent.protocol import AckStatus
from function_app.domain.actions.trials import Trial
from function_app.ports.tables import Row
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person

TASK = "red_cube_in_green_tray"
TASKS = "/robot-types/ur5_gripper/tasks"
TRIALS = f"{TASKS}/{TASK}/trials"
HASH = "0" * 64
DAY_S = 86_400
SUCCESS = {"verdict": "success", "duration_s": 12.5, "simulated": True, "software": "1.2", "type_version": 3}


def gripper(cloud: Cloud, owner: Person) -> Robot:
    """A connected robot of a type with tasks."""
    robot = cloud.robot()
    robot.robot_type = "ur5_gripper"
    robot.pair(owner)
    return robot.connect()


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
    """The trials of the task, newest first."""
    return person.pages(TRIALS, **query)


def report(person: Person) -> dict[str, Any]:
    """The task with its success rates and batches."""
    answer = person.get(f"{TASKS}/{TASK}")
    assert answer.status_code == 200, answer.text
    body: dict[str, Any] = answer.json()
    return body


def partition_of(cloud: Cloud, robot: Robot) -> str:
    """Partition of the robot's trials in the table."""
    device = cloud.run(cloud.functions.devices.get_as_owner(robot.device))
    assert device is not None
    return f"{robot.device}/{device.pairing}"


def rows(cloud: Cloud, robot: Robot) -> tuple[Any, ...]:
    """The stored rows of the robot's trials."""
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
