"""Rows keep the fields and the version that a newer server has written."""

import json

from device_agent.protocol import AckStatus, Mode, State
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import MOVE, Cloud, Person
from tests.harness.cloud.memory import Memory

LATER = {"kind": "of a newer server"}
NEWER = 7


def use(cloud: Cloud, anna: Person, robot: Robot, label: str) -> None:
    """Change rows of most capabilities."""
    device = robot.device
    assert anna.put(f"/devices/{device}/label", {"label": label}).status_code == 200
    assert robot.enroll(software=label).status_code == 200
    robot.connect()
    robot.publish_state(State(device="arm", at_ms=1, tick_ms=1, mode=Mode.IDLE, epoch=0))
    started = anna.post(f"/devices/{device}/actions", {"request": MOVE})
    assert started.status_code == 202, started.text
    robot.report(started.json()["id"], AckStatus.DONE)
    cloud.sweep()


def test_a_change_keeps_the_fields_and_the_version_of_a_newer_server(
    memory: Memory, cloud: Cloud, anna: Person, robot: Robot
) -> None:
    use(cloud, anna, robot, "first")
    before = {(table, row.partition, row.key): row for table, row in memory.tables.rows()}
    for stored in memory.tables._partitions.values():
        for key, (etag, text) in stored.rows.items():
            newer = {**json.loads(text), "later": LATER, "~schema": NEWER}
            stored.rows[key] = (etag, json.dumps(newer).encode())
    use(cloud, anna, robot, "second")
    after = {(table, row.partition, row.key): row for table, row in memory.tables.rows()}
    changed = {place for place, row in after.items() if place in before and row.etag != before[place].etag}
    assert {place[0] for place in changed} >= {"Agents", "Audit", "Control", "Latency"}
    lost = {place for place in changed if after[place].data.get("later") != LATER or after[place].schema != NEWER}
    assert lost == set()
