"""The timer resends unanswered commands, ends lost actions and deletes expired rows."""

import asyncio
from unittest import mock

import pytest

from device_agent.protocol import AckStatus, CancelAction, RunMovement
from function_app.domain.actions.action import JOURNAL_MS
from function_app.services.maintenance.scheduler import TIME_LIMIT
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.fixtures.cloud import Crashing
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.cloud.memory import Memory
from tests.harness.crash_injection import Killed, at_instance
from tests.unit.function_app.services.actions.queue_requests import control_rows, pass_time, reminders, started

MINE = "/robot-types/ur5/movements/mine"


@pytest.fixture
def unanswered(anna: Person, robot: Robot) -> str:
    """An action that the robot does not acknowledge."""
    robot.silent = True
    action: str = anna.start(robot.device, ttl_ms=2_000).json()["id"]
    return action


def test_a_command_is_resent_unchanged_until_it_is_acknowledged(cloud: Cloud, anna: Person, robot: Robot) -> None:
    robot.silent = True
    action = anna.start(robot.device).json()["id"]
    cloud.sweep()
    assert len(robot.payloads[action]) == 1, "not before it is due"
    for copies in (2, 3):
        pass_time(cloud, 1.1)
        assert len(robot.payloads[action]) == copies
    assert len(set(robot.payloads[action])) == 1
    robot.report(action, AckStatus.RECEIVED)
    assert anna.action(action)["status"] == "received"
    pass_time(cloud, 3)
    assert len(robot.payloads[action]) == 3
    robot.report(action, AckStatus.DONE)
    assert anna.action(action)["status"] == "done"
    pass_time(cloud, 400, step_s=200)
    assert reminders(cloud) == []


def test_a_script_is_resent_as_it_was_at_the_start(cloud: Cloud, anna: Person, robot: Robot) -> None:
    robot.silent = True
    anna.put(MINE, {"source": "robot.home()"})
    action = anna.start(robot.device, request={"kind": "run_movement", "name": "mine"}).json()["id"]
    anna.put(MINE, {"source": "robot.dance()"})
    anna.delete(MINE)
    pass_time(cloud, 1.1)
    assert len(robot.payloads[action]) == 2
    assert len(set(robot.payloads[action])) == 1
    (command,) = robot.received(RunMovement)
    assert isinstance(command.request, RunMovement)
    assert command.request.source == "robot.home()"


def test_an_unacknowledged_action_is_unknown_until_the_device_reports(
    cloud: Cloud, anna: Person, robot: Robot, unanswered: str
) -> None:
    pass_time(cloud, 4.5, step_s=0.5)
    assert anna.action(unanswered)["status"] == "published", "an ack may still arrive"
    pass_time(cloud, 1, step_s=0.5)
    shown = anna.action(unanswered)
    assert (shown["status"], shown["reason"]["code"]) == ("unknown", "no-report")
    assert "unknown_ms" in shown["times"]
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    robot.silent = False
    assert anna.start(robot.device, wait_ms=10_000).status_code == 200
    robot.report(unanswered, AckStatus.DONE)
    shown = anna.action(unanswered)
    assert (shown["status"], shown["reason"]) == ("done", None)
    robot.fail(unanswered, "held", "The arm had to hold.")
    assert anna.action(unanswered)["status"] == "done", "the first terminal status remains"


def test_a_device_that_never_received_the_command_reports_it_as_expired(
    cloud: Cloud, anna: Person, robot: Robot, unanswered: str
) -> None:
    robot.forget(unanswered)
    robot.silent = False
    cloud.clock.advance(2)
    pass_time(cloud, 1.1)
    assert anna.action(unanswered)["status"] == "expired"
    assert len(robot.payloads[unanswered]) == 1


@pytest.mark.parametrize("online", [True, False])
def test_only_an_online_device_is_asked_for_an_unknown_outcome(
    cloud: Cloud, anna: Person, robot: Robot, unanswered: str, online: bool
) -> None:
    pass_time(cloud, 6)
    robot.publish_presence(online=online)
    copies = len(robot.payloads[unanswered])
    pass_time(cloud, 100, step_s=10)
    assert (len(robot.payloads[unanswered]) > copies) is online
    assert len(set(robot.payloads[unanswered])) == 1
    assert anna.action(unanswered)["status"] == "unknown"


def test_an_unknown_outcome_is_lost_after_a_week(cloud: Cloud, anna: Person, robot: Robot, unanswered: str) -> None:
    pass_time(cloud, 6)
    robot.publish_presence(online=False)
    cloud.clock.advance(JOURNAL_MS / 1000)
    anna = cloud.sign_in("anna")
    pass_time(cloud, 2)
    shown = anna.action(unanswered)
    assert (shown["status"], shown["reason"]["code"]) == ("failed", "lost")


def test_a_report_after_a_jump_of_the_clock_replaces_a_lost_end(
    cloud: Cloud, anna: Person, robot: Robot, unanswered: str
) -> None:
    robot.publish_presence(online=False)
    cloud.clock.advance(400 * 86_400)
    pass_time(cloud, 120, step_s=10)
    anna = cloud.sign_in("anna")
    assert anna.action(unanswered)["reason"]["code"] == "lost"
    robot.report(unanswered, AckStatus.DONE)
    assert anna.action(unanswered)["status"] == "done"


@pytest.mark.parametrize("gone", ["permission", "movement"])
def test_an_unknown_outcome_remains_without_permission_or_script(
    cloud: Cloud, anna: Person, robot: Robot, gone: str
) -> None:
    robot.silent = True
    anna.put(MINE, {"source": "robot.home()"})
    action = anna.start(robot.device, request={"kind": "run_movement", "name": "mine"}, ttl_ms=2_000).json()["id"]
    if gone == "permission":
        anna.post("/auth/sign-out")
        anna = cloud.sign_in("anna")
    else:
        robot_type_rows = cloud.functions.movements
        with mock.patch.object(robot_type_rows, "pinned_source", mock.AsyncMock(return_value=None)):
            pass_time(cloud, 10)
    pass_time(cloud, 10)
    assert anna.action(action)["status"] == "unknown"
    robot.report(action, AckStatus.DONE)
    assert anna.action(action)["status"] == "done"


def test_unpairing_ends_an_unknown_outcome(cloud: Cloud, anna: Person, robot: Robot, unanswered: str) -> None:
    pass_time(cloud, 6)
    assert anna.action(unanswered)["status"] == "unknown"
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    pass_time(cloud, 60, step_s=5)
    row = control_rows(cloud, robot.device)[f"action:{unanswered.rpartition('-')[2]}"]
    assert (row["status"], row["reason"]["code"]) == ("failed", "lost")


def test_no_outcome_becomes_unknown_while_the_ingest_is_behind(
    cloud: Cloud, anna: Person, robot: Robot, unanswered: str
) -> None:
    for _ in range(20):
        cloud.clock.advance(1)
        cloud.run(cloud.functions.scheduler.run_due_jobs(current=False))
    assert anna.action(unanswered)["status"] == "published"
    assert len(robot.payloads[unanswered]) > 15, "it asks the device"


def test_an_action_beyond_its_timeout_is_cancelled_then_unknown(cloud: Cloud, anna: Person, robot: Robot) -> None:
    action = anna.start(robot.device, wait_ms=10_000, timeout_ms=6_000).json()["id"]
    pass_time(cloud, 5)
    assert anna.action(action)["status"] == "started"
    pass_time(cloud, 1.5)
    assert anna.action(action)["status"] == "started"
    cancelled = [command for command in robot.received(CancelAction) if command.request == CancelAction(action=action)]
    assert {command.caller for command in cancelled} == {TIME_LIMIT}
    pass_time(cloud, 3)
    assert anna.action(action)["status"] == "unknown"
    assert anna.start(robot.device, wait_ms=10_000).status_code == 200
    robot.report(action, AckStatus.CANCELLED)
    assert anna.action(action)["status"] == "cancelled"


def test_a_cancelled_action_is_not_resent(cloud: Cloud, anna: Person, robot: Robot, unanswered: str) -> None:
    assert anna.post(f"/actions/{unanswered}/cancel").status_code == 202
    pass_time(cloud, 1.1)
    assert len(robot.received(CancelAction)) == 2, "the cancel command is resent"
    assert len(robot.payloads[unanswered]) == 1
    robot.forget(unanswered)
    robot.silent = False
    pass_time(cloud, 5)
    assert anna.action(unanswered)["status"] == "cancelled"
    assert anna.start(robot.device, wait_ms=10_000).status_code == 200


def test_unpairing_ends_unacknowledged_actions(cloud: Cloud, anna: Person, robot: Robot, unanswered: str) -> None:
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    copies = len(robot.payloads[unanswered])
    pass_time(cloud, 2)
    row = control_rows(cloud, robot.device)[f"action:{unanswered.rpartition('-')[2]}"]
    assert (row["status"], row["reason"]["code"]) == ("failed", "unpaired")
    assert len(robot.payloads[unanswered]) == copies
    pass_time(cloud, 400, step_s=200)
    assert reminders(cloud) == []


def test_concurrent_timers_do_each_job_once(cloud: Cloud, anna: Person, robot: Robot, unanswered: str) -> None:
    async def together() -> None:
        await asyncio.gather(*(cloud.functions.scheduler.run_due_jobs() for _ in range(4)))

    for _ in range(8):
        cloud.clock.advance(1)
        cloud.run(together())
    assert anna.action(unanswered)["status"] == "unknown"
    assert len(set(robot.payloads[unanswered])) == 1
    robot.report(unanswered, AckStatus.DONE)
    pass_time(cloud, 400, step_s=200)
    assert reminders(cloud) == []


def test_expired_codes_and_links_are_deleted(cloud: Cloud, memory: Memory) -> None:
    valid = cloud.robot()
    cloud.link("anna")
    cloud.robot().enroll()
    cloud.clock.advance(25 * 3600)
    valid.enroll()
    for _ in range(20):
        cloud.sweep()
    assert [table for table, _ in memory.tables.rows("Claims", "SignIns")] == ["Claims"]


def test_an_action_is_sent_when_the_broker_is_back(
    cloud: Cloud, anna: Person, robot: Robot, broker: MemoryBroker
) -> None:
    broker.reachable = False
    answer = anna.start(robot.device, wait_ms=1_000, ttl_ms=60_000)
    assert (answer.status_code, answer.json()["status"]) == (202, "created")
    problem(anna.post(f"/devices/{robot.device}/stop"), 503, "broker-unavailable")
    broker.reachable = True
    action = answer.json()["id"]
    pass_time(cloud, 5)
    assert started(anna, action)
    assert len(set(robot.payloads[action])) == 1


@pytest.mark.parametrize("writes", range(1, 9))
def test_a_claim_killed_after_any_write_is_complete_or_repeatable(
    cloud: Cloud, crashing: Crashing, writes: int
) -> None:
    anna = cloud.sign_in("anna")
    robot = cloud.robot()
    code = robot.code()
    process, crash = crashing(cloud.clock)
    client = at_instance(process, anna)
    client.get("/accounts/me")
    crash.left = writes
    client.post("/agents/claim", {"code": code})
    if robot.enrollment()["state"] == "waiting":
        assert anna.get("/devices").json()["items"] == []
        assert anna.post("/agents/claim", {"code": code}).status_code == 200
    assert [item["id"] for item in anna.get("/devices").json()["items"]] == [robot.device]


def test_an_account_killed_after_any_write_is_completed(cloud: Cloud, crashing: Crashing) -> None:
    for writes in range(1, 4):
        process, crash = crashing(cloud.clock)
        crash.left = writes
        with pytest.raises(Killed):
            process.run(process.functions.sign_in.account(f"anna{writes}"))
        anna = cloud.sign_in(f"anna{writes}")
        assert len(anna.get("/spaces").json()["items"]) == 1
        assert cloud.run(cloud.functions.sign_in.named(anna.account)) == f"anna{writes}"


@pytest.mark.parametrize("restarted", [False, True])
@pytest.mark.parametrize("state", ["published", "started", "unknown"])
def test_an_action_frees_its_device_although_the_clock_is_set_back(
    cloud: Cloud, anna: Person, robot: Robot, state: str, restarted: bool
) -> None:
    robot.silent = state != "started"
    wait_ms = 10_000 if state == "started" else 0
    action = anna.start(robot.device, wait_ms=wait_ms, ttl_ms=2_000, timeout_ms=6_000).json()["id"]
    pass_time(cloud, 6 if state == "unknown" else 1)
    assert anna.action(action)["status"] == state
    cloud.clock.advance(-3600)
    anna = cloud.sign_in("anna")
    if restarted:
        del cloud.functions.scheduler  # created again at the next use
    pass_time(cloud, 12)
    assert anna.action(action)["status"] == "unknown"
    robot.silent = False
    assert anna.start(robot.device, wait_ms=10_000).status_code == 200
    copies = len(robot.payloads[action])
    pass_time(cloud, 40, step_s=5)
    assert len(robot.payloads[action]) > copies, "the device is asked how it ended"
    robot.report(action, AckStatus.DONE)
    assert anna.action(action)["status"] == "done"


def test_a_running_action_keeps_its_time_limit_when_the_clock_is_set_back(
    cloud: Cloud, anna: Person, robot: Robot
) -> None:
    action = anna.start(robot.device, wait_ms=10_000, timeout_ms=6_000).json()["id"]
    cloud.clock.advance(-3600)
    anna = cloud.sign_in("anna")
    pass_time(cloud, 5)
    assert (anna.action(action)["status"], robot.received(CancelAction)) == ("started", [])
    robot.report(action, AckStatus.DONE)
    assert anna.action(action)["status"] == "done"


def test_a_queued_action_expires_although_the_clock_is_set_back(cloud: Cloud, anna: Person, robot: Robot) -> None:
    anna.start(robot.device, wait_ms=10_000, timeout_ms=60_000)
    action = anna.start(robot.device, policy="queue", queue_ms=10_000).json()["id"]
    cloud.clock.advance(-3600)
    anna = cloud.sign_in("anna")
    pass_time(cloud, 9)
    assert anna.action(action)["status"] == "queued"
    pass_time(cloud, 3)
    assert anna.action(action)["status"] == "expired"


def test_an_expiring_key_keeps_its_reminder_when_the_clock_is_set_back(cloud: Cloud) -> None:
    reminder = ("key-expires:k", cloud.clock.now_ms() + 7_200_000)
    cloud.run(cloud.functions.reminders.schedule(*reminder))
    cloud.clock.advance(-3600)
    pass_time(cloud, 2)
    assert reminders(cloud) == [f"{reminder[1]:013d}:{reminder[0]}"]
