"""Requests and checks of the action queue tests."""

from typing import Any

from device_agent.protocol import MoveJoints
from function_app.services.storage import records
from function_app.services.storage.reminders import SHARDS
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person

QUEUE: dict[str, Any] = {"policy": "queue"}


def queued(person: Person, device: str, **options: Any) -> str:
    """Queue one more action and return its id."""
    answer = person.start(device, **QUEUE, **options)
    assert (answer.status_code, answer.json()["status"]) == (202, "queued"), answer.text
    assert answer.json()["reason"] is None
    action: str = answer.json()["id"]
    return action


def started(person: Person, action: str) -> bool:
    return bool(person.action(action, wait_ms=20_000, wait_for="started")["status"] == "started")


def sent(robot: Robot) -> list[str]:
    """Actions that were sent to the robot, in order."""
    return [command.id for command in robot.received(MoveJoints)]


def reason(person: Person, action: str) -> tuple[str, str]:
    shown = person.action(action, wait_ms=20_000)
    return shown["status"], shown["reason"]["code"]


def reminders(cloud: Cloud) -> list[str]:
    """Keys of the timer's reminders, without those of the audit log."""
    pages = [cloud.run(cloud.functions.tables.query(records.PENDING, str(shard))) for shard in range(SHARDS)]
    keys = [row.key for page in pages for row in page.rows]
    return [key for key in keys if key.split(":")[1] not in {"anchor", "audit"}]


def control_rows(cloud: Cloud, device: str) -> dict[str, dict[str, Any]]:
    page = cloud.run(cloud.functions.tables.query(records.CONTROL, device, limit=1000))
    return {row.key: dict(row.data) for row in page.rows}


def pass_time(cloud: Cloud, seconds: float, step_s: float = 1.0) -> None:
    """Advance the clock in steps, with a round of the timer after each."""
    while seconds > 0:
        cloud.clock.advance(min(step_s, seconds))
        seconds -= step_s
        cloud.sweep()
