"""Requests and checks of the action queue tests."""

from typing import Any

from device_agent.protocol import MoveJoints, topics
from function_app.services.storage import records
from function_app.services.storage.reminders import SHARDS
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person

Pair = tuple[Person, Robot]
QUEUE: dict[str, Any] = {"policy": "queue"}
ENDED = {"done", "failed", "expired", "cancelled"}


def queued(person: Person, device: str, **options: Any) -> str:
    """One more that waits; gives its id."""
    answer = person.start(device, **QUEUE, **options)
    assert (answer.status_code, answer.json()["status"]) == (202, "queued"), answer.text
    assert answer.json()["reason"] is None
    action: str = answer.json()["id"]
    return action


def sent(robot: Robot) -> list[str]:
    """Actions that were sent to the robot, in order."""
    return [command.id for command in robot.heard(MoveJoints)]


def statuses(person: Person, *actions: str) -> list[str]:
    return [person.action(action)["status"] for action in actions]


def reason(person: Person, action: str) -> tuple[str, str]:
    found = person.action(action)
    return found["status"], found["reason"]["code"]


def notes(cloud: Cloud) -> list[str]:
    pages = [cloud.run(cloud.functions.tables.query(records.PENDING, str(shard))) for shard in range(SHARDS)]
    keys = [row.key for page in pages for row in page.rows]
    return [key for key in keys if key.split(":")[1] not in {"anchor", "audit"}]


def pass_time(cloud: Cloud, seconds: float, step_s: float = 1.0) -> None:
    while seconds > 0:
        cloud.clock.advance(min(step_s, seconds))
        seconds -= step_s
        cloud.sweep()


def deliver_ack(process: Cloud, robot: Robot, ack: bytes) -> None:
    """Have one process take an ack in, which the others do not hear."""
    process.run(process.functions.action_acks.ingest(topics.parse(robot.topic(topics.ACK)), ack))
