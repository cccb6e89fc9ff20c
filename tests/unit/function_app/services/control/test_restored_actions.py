"""Actions that were in progress when a backup was made end truthfully after it was restored."""

from dataclasses import replace
from typing import TYPE_CHECKING, cast

import pytest

from device_agent.protocol import AckStatus, Command, Reason
from device_agent.runtime.authority.lease_gate import LeaseGate
from function_app.domain.actions.action import RETRY_MS
from function_app.domain.audit.hash_chain import Head
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person
from tests.unit.function_app.services.actions.queue_requests import control_rows, pass_time, queued, reminders, sent
from tests.unit.function_app.services.control.test_restored_tables import Backup, Restore, backup, gate, use

if TYPE_CHECKING:
    from tests.fakes.tables import MemoryTables

__all__ = ["backup", "gate"]


def settle(cloud: Cloud, restore: Restore) -> int:
    """Restore the tables, as the command does before the server starts."""
    created_ms = cloud.clock.now_ms()
    restore()
    tables = cast("MemoryTables", cloud.functions.tables)
    agents = sorted({row.partition for _, row in tables.rows(records.AGENTS)})
    count = cloud.run(cloud.functions.restored_backup.settle(created_ms=created_ms, agents=agents))
    cloud.sweep()
    return count


def running(command: Command) -> tuple[AckStatus, ...]:
    del command
    return AckStatus.RECEIVED, AckStatus.ACCEPTED, AckStatus.STARTED


@pytest.mark.parametrize("acked", [(), (AckStatus.RECEIVED,), (AckStatus.RECEIVED, AckStatus.STARTED)], ids=str)
def test_an_action_that_ended_after_the_backup_is_done(
    cloud: Cloud, anna: Person, robot: Robot, backup: Backup, acked: tuple[AckStatus, ...]
) -> None:
    robot.reports = lambda _: acked
    action = anna.start(robot.device).json()["id"]
    restore = backup()
    done = robot.report(action, AckStatus.DONE)
    robot._last_acks[action] = b'{"id":"%s","status":"done","sequence":%d,"at_ms":1,"tick_ms":1}' % (
        action.encode(),
        done.sequence,
    )
    assert anna.action(action)["status"] == "done"
    pass_time(cloud, 20)
    assert settle(cloud, restore) == 1
    assert anna.action(action)["status"] == "done"
    assert len(sent(robot)) == 1, "it did not run again"
    robot.reports = running
    assert anna.start(robot.device, wait_ms=20_000, wait_for="started").status_code == 200


def test_an_action_without_an_answer_is_unknown_and_does_not_block(
    cloud: Cloud, anna: Person, robot: Robot, backup: Backup
) -> None:
    robot.silent = True
    action = anna.start(robot.device, timeout_ms=1_000).json()["id"]
    restore = backup()
    assert settle(cloud, restore) == 1
    pass_time(cloud, 120)
    shown = anna.action(action)
    assert shown["status"] == "unknown"
    robot.silent = False
    assert anna.start(robot.device, wait_ms=20_000, wait_for="started").status_code == 200


@pytest.mark.parametrize("granted_before", [False, True])
def test_an_epoch_granted_before_the_restore_is_never_granted_again(
    cloud: Cloud, anna: Person, robot: Robot, backup: Backup, granted_before: bool
) -> None:
    """Even if the device has not received the grant yet: both operators would hold the key of this epoch."""
    if granted_before:
        lease = anna.post(f"/devices/{robot.device}/lease", {"lease_ms": 10_000}).json()
        anna.delete(f"/devices/{robot.device}/lease/{lease['epoch']}")
    restore = backup()
    lost = anna.post(f"/devices/{robot.device}/lease", {"lease_ms": 10_000}).json()["epoch"]
    settle(cloud, restore)
    robot.gate = LeaseGate()  # the device has not received any of them
    assert anna.post(f"/devices/{robot.device}/lease", {"lease_ms": 10_000}).json()["epoch"] > lost


def test_queued_actions_of_a_backup_do_not_start(cloud: Cloud, anna: Person, robot: Robot, backup: Backup) -> None:
    robot.reports = running
    first = anna.start(robot.device).json()["id"]
    waiting = [queued(anna, robot.device) for _ in range(2)]
    restore = backup()
    robot.report(first, AckStatus.DONE)
    for action in waiting:
        robot.report(action, AckStatus.DONE)
    before = sent(robot)
    robot._last_acks[first] = robot._last_acks[waiting[-1]].replace(waiting[-1].encode(), first.encode())
    assert settle(cloud, restore) == 3
    for action in waiting:
        shown = anna.action(action)
        assert (shown["status"], shown["reason"]["code"]) == ("cancelled", "restored")
    assert sent(robot) == before


def test_the_audit_log_names_the_restore_and_reports_missing_records(
    cloud: Cloud, anna: Person, robot: Robot, backup: Backup
) -> None:
    del robot
    reader = cloud.functions.audit_reader
    restore = backup()

    def head() -> Head:
        found = cloud.run(reader.head(anna.account))
        assert found is not None
        return found

    old = head()
    for number in range(3):
        anna.post("/api-keys", {"name": f"key {number}", "role": "viewer", "days": 1})
    lost = head()
    assert lost.seq > old.seq
    settle(cloud, restore)
    assert cloud.run(reader.verify(anna.account)).broken == ""
    for number in range(5):
        anna.post("/api-keys", {"name": f"other {number}", "role": "viewer", "days": 1})
    result = cloud.run(reader.verify(anna.account, expected=(old, lost)))
    assert result.broken == ""
    assert f"restored at record {old.seq + 1}" in result.missing
    assert "are missing" in result.missing
    tampered = Head(old.seq, "0" * 64)
    assert "differs from the anchor" in cloud.run(reader.verify(anna.account, expected=(tampered, lost))).broken


def test_a_reissued_action_has_a_lease_a_retry_and_events(
    cloud: Cloud, anna: Person, robot: Robot, backup: Backup
) -> None:
    restore = backup()
    use(anna, robot)
    restore()
    robot.silent = True
    action = anna.start(robot.device, wait_ms=0).json()["id"]
    cloud.clock.advance(0.5)
    assert robot.gate is not None
    robot.report(action, AckStatus.FAILED, reason=Reason(code="stale_epoch", message="", epoch=robot.gate.epoch))
    rows = control_rows(cloud, robot.device)
    lease, row = rows["now:lease"], rows[f"action:{action.rpartition('-')[2]}"]
    assert (lease["epoch"], lease["action"], lease["pairing"]) == (row["epoch"], action, row["pairing"])
    assert (lease["epoch"], row["reissuable"]) == (8, False)
    taken = rows[f"event:control-taken-{lease['epoch']}"]
    assert (taken["owner"], taken["by"]["account"], taken["event"]["data"]["from"]) == (anna.account,) * 2 + ("anna",)
    assert f"{row['turn_ms'] + RETRY_MS}:{action}" in reminders(cloud)
    assert row["turn_ms"] >= row["created_ms"] + 500
    assert not cloud.run(cloud.functions.queues.reissue(action, lease["epoch"])), "at most once"
    assert not cloud.run(cloud.functions.queues.reissue(f"{robot.device}-{'0' * 20}", lease["epoch"])), "unknown"


@pytest.mark.parametrize("missing", ["permission", "lease"])
def test_an_action_is_not_reissued_without_permission_or_lease(
    cloud: Cloud, anna: Person, robot: Robot, backup: Backup, missing: str
) -> None:
    restore = backup()
    use(anna, robot)
    restore()
    robot.silent = True
    action = anna.start(robot.device, wait_ms=0).json()["id"]
    assert robot.gate is not None
    if missing == "permission":
        cloud.run(cloud.functions.action_store.change(action, lambda stored: replace(stored, pairing="another")))
    else:
        lease = cloud.run(cloud.functions.tables.get(records.CONTROL, robot.device, "now:lease"))
        assert lease is not None
        cloud.run(cloud.functions.tables.delete(records.CONTROL, lease))
    assert cloud.run(cloud.functions.queues.reissue(action, robot.gate.epoch)) is False
    assert len(sent(robot)) == 1
