"""Timer repairs: unacknowledged commands, actions without an end, and processes killed between two writes."""

import time
from collections.abc import Callable
from typing import Any

import pytest

from device_agent.protocol import AckStatus, CancelAction, Command, MoveJoints, RunMovement
from function_app.services.maintenance.scheduler import ORPHAN_MS
from function_app.services.storage import records
from function_app.services.storage.reminders import SHARDS
from tests.fakes.agent import Answers, Robot
from tests.fakes.broker import MemoryBroker
from tests.fixtures.cloud import Mortal
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.cloud.memory import Memory
from tests.harness.crash_injection import Killed, elsewhere
from tests.harness.network.brokers import wait_until

Pair = tuple[Person, Robot]
TTL_S, TIMEOUT_S = 2, 6
SHORT = {"ttl_ms": TTL_S * 1000, "timeout_ms": TIMEOUT_S * 1000}
WAVE = {"kind": "run_movement", "name": "slow_square", "parameters": {"side_m": 0.1}}


def notes(cloud: Cloud) -> list[str]:
    """Actions that the timer still means to look at, beside the chains of who did what."""
    pages = [cloud.run(cloud.functions.tables.query(records.PENDING, str(shard))) for shard in range(SHARDS)]
    keys = [row.key for page in pages for row in page.rows]
    return [key for key in keys if key.split(":")[1] not in {"anchor", "audit"}]


def rows(cloud: Cloud, device: str) -> dict[str, dict[str, Any]]:
    page = cloud.run(cloud.functions.tables.query(records.CONTROL, device, limit=1000))
    return {row.key: dict(row.data) for row in page.rows}


def pass_time(cloud: Cloud, seconds: float, step_s: float = 1.0) -> None:
    """Put the clock forward in steps, with a round of the timer after each."""
    while seconds > 0:
        cloud.clock.advance(min(step_s, seconds))
        seconds -= step_s
        cloud.sweep()


class TestWithoutAnswer:
    @pytest.mark.parametrize("request_", [None, WAVE], ids=["move", "movement"])
    def test_a_command_is_sent_again_with_the_same_bytes_until_it_is_answered(
        self, cloud: Cloud, pair: Pair, request_: dict[str, Any] | None
    ) -> None:
        anna, robot = pair
        robot.silent = True
        asked = {} if request_ is None else {"request": request_}
        action = anna.start(robot.device, **asked).json()["id"]
        wait_until(lambda: robot.commands, "the command")
        cloud.sweep()
        assert len(robot.payloads[action]) == 1, "not before its time"
        pass_time(cloud, 1.1)
        wait_until(lambda: len(robot.payloads[action]) == 2, "the command again")
        pass_time(cloud, 1.1)
        wait_until(lambda: len(robot.payloads[action]) == 3, "the command a third time")
        assert len(set(robot.payloads[action])) == 1
        robot.report(action, AckStatus.RECEIVED)
        wait_until(lambda: anna.action(action)["status"] == "received", "the ack")
        pass_time(cloud, 3)
        assert len(robot.payloads[action]) == 3
        robot.report(action, AckStatus.DONE)
        assert anna.action(action, wait_ms=10_000)["status"] == "done"
        pass_time(cloud, 400, step_s=200)
        assert notes(cloud) == []

    def test_the_same_script_is_sent_again_though_it_was_changed_since(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        robot.silent = True
        anna.put("/robot-types/ur5/movements/mine", {"source": "robot.home()"})
        action = anna.start(robot.device, request={"kind": "run_movement", "name": "mine"}).json()["id"]
        anna.put("/robot-types/ur5/movements/mine", {"source": "robot.dance()"})
        anna.delete("/robot-types/ur5/movements/mine")
        pass_time(cloud, 1.1)
        wait_until(lambda: len(robot.payloads.get(action, [])) == 2, "the command again")
        assert len(set(robot.payloads[action])) == 1
        assert [command.request.source for command in robot.heard(RunMovement)] == [  # type: ignore[union-attr]
            "robot.home()"
        ]

    def test_it_expires_after_its_time_to_live(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        robot.silent = True
        action = anna.start(robot.device, ttl_ms=2_000).json()["id"]
        pass_time(cloud, 4.5, step_s=0.5)
        assert anna.action(action)["status"] == "published", "an ack may still come"
        pass_time(cloud, 1, step_s=0.5)
        ended = anna.action(action)
        assert (ended["status"], ended["reason"]["code"]) == ("expired", "no-answer")
        assert "expired_ms" in ended["times"]
        assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
        robot.silent = False
        assert anna.start(robot.device, wait_ms=10_000).status_code == 200
        robot.report(action, AckStatus.DONE)
        time.sleep(0.1)
        assert anna.action(action)["status"] == "expired", "the first end stays"

    def test_what_started_and_never_ended_is_lost_and_the_device_told(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        action = anna.start(robot.device, wait_ms=10_000, **SHORT).json()["id"]
        pass_time(cloud, TIMEOUT_S - 1)
        assert anna.action(action)["status"] == "started"
        pass_time(cloud, 1.5)
        ended = anna.action(action)
        assert (ended["status"], ended["reason"]["code"]) == ("failed", "lost")
        wait_until(lambda: robot.heard(CancelAction), "the cancel")
        assert [command.request for command in robot.heard(CancelAction)] == [CancelAction(action=action)]
        assert anna.start(robot.device, wait_ms=10_000).status_code == 200

    def test_what_was_cancelled_unanswered_is_never_sent_again(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        robot.silent = True
        action = anna.start(robot.device, ttl_ms=2_000).json()["id"]
        assert anna.post(f"/actions/{action}/cancel").status_code == 202
        pass_time(cloud, 1.1)
        wait_until(lambda: len(robot.heard(CancelAction)) == 2, "the cancel again")
        assert len(robot.payloads[action]) == 1
        pass_time(cloud, 5)
        assert anna.action(action)["status"] == "cancelled"
        robot.silent = False
        assert anna.start(robot.device, wait_ms=10_000).status_code == 200

    def test_an_unpublished_command_ends_with_the_unpairing(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        robot.silent = True
        action = anna.start(robot.device).json()["id"]
        assert anna.delete(f"/agents/{robot.id}").status_code == 204
        told = len(robot.payloads.get(action, []))
        pass_time(cloud, 2)
        key = f"action:{action.rpartition('-')[2]}"
        found = rows(cloud, robot.device)[key]
        assert (found["status"], found["reason"]["code"]) == ("failed", "unpaired")
        assert len(robot.payloads.get(action, [])) == told
        pass_time(cloud, 400, step_s=200)
        assert notes(cloud) == []


def test_two_timers_at_once_do_no_harm(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    robot.silent = True
    action = anna.start(robot.device, **SHORT).json()["id"]

    async def together() -> None:
        import asyncio

        await asyncio.gather(*(cloud.functions.scheduler.run_due_jobs() for _ in range(4)))

    for _ in range(8):
        cloud.clock.advance(1)
        cloud.run(together())
    assert anna.action(action)["status"] == "expired"
    assert len(set(robot.payloads[action])) == 1
    pass_time(cloud, 10, step_s=5)
    assert notes(cloud) == []


def test_codes_and_links_that_ran_out_are_forgotten(cloud: Cloud, memory: Memory) -> None:
    kept = cloud.robot()
    cloud.link("anna")
    cloud.robot().enroll()
    cloud.clock.advance(25 * 3600)
    kept.enroll()
    for _ in range(20):
        cloud.sweep()
    assert [table for table, _ in memory.tables.rows("Claims", "SignIns")] == ["Claims"]


def test_while_the_broker_is_away_an_action_is_kept_and_sent_when_it_is_back(
    cloud: Cloud, pair: Pair, broker: MemoryBroker
) -> None:
    anna, robot = pair
    broker.reachable = False
    answer = anna.start(robot.device, wait_ms=1_000, ttl_ms=60_000)
    assert (answer.status_code, answer.json()["status"]) == (202, "created")
    problem(anna.post(f"/devices/{robot.device}/stop"), 503, "broker-unavailable")
    broker.reachable = True
    action = answer.json()["id"]

    def started() -> bool:
        pass_time(cloud, 1.1)
        return bool(anna.action(action, wait_ms=200, wait_for="started")["status"] == "started")

    wait_until(started, "the command to arrive")
    assert len(set(robot.payloads[action])) == 1


# ---------------------------------------------------------------- killed between two writes


SILENT: Callable[[Command], Answers] = lambda _: ()  # noqa: E731
STARTS: Callable[[Command], Answers] = lambda _: (AckStatus.RECEIVED, AckStatus.STARTED)  # noqa: E731
ENDS: Callable[[Command], Answers] = lambda _: (AckStatus.RECEIVED, AckStatus.STARTED, AckStatus.DONE)  # noqa: E731
MOST_WRITES = 12


def settled(cloud: Cloud, anna: Person, robot: Robot) -> None:
    """Let time pass and see that nothing is left open."""
    robot.reports = SILENT
    pass_time(cloud, TIMEOUT_S + 4, step_s=0.5)
    pass_time(cloud, ORPHAN_MS / 1000 + 2, step_s=31)
    found = rows(cloud, robot.device)
    actions = {key: data for key, data in found.items() if key.startswith("action:")}
    for data in actions.values():
        assert data["status"] in {"done", "failed", "expired", "cancelled"}, data
    assert found.get("now:slot", {"action": ""})["action"] == ""
    assert notes(cloud) == []
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    known = {data["id"] for data in actions.values()}
    for action, payloads in robot.payloads.items():
        assert len(set(payloads)) == 1, "the same command has the same bytes"
        request = next(command.request for command in robot.commands if command.id == action)
        assert action in known or not isinstance(request, MoveJoints | RunMovement), "nothing runs that is not written"
    robot.reports = STARTS
    assert anna.start(robot.device, wait_ms=10_000).json()["status"] == "started"


@pytest.mark.parametrize("reports", [SILENT, STARTS, ENDS], ids=["silent", "starts", "ends"])
@pytest.mark.parametrize("request_", [{}, {"request": WAVE}], ids=["move", "movement"])
def test_a_start_killed_after_any_write_leaves_nothing_open(
    cloud: Cloud, pair: Pair, mortal: Mortal, reports: Callable[[Command], Answers], request_: dict[str, Any]
) -> None:
    anna, robot = pair
    for after in range(1, MOST_WRITES):
        robot.reports = reports
        process, knife = mortal(cloud.clock)
        there = elsewhere(process, anna)
        assert there.get("/accounts/me").status_code == 200
        knife.left = after
        answer = there.start(robot.device, wait_ms=100, wait_for="done", once=f"k{after}", **SHORT, **request_)
        survived = knife.left > 0
        assert (answer.status_code < 500) is survived
        before = {key for key in rows(cloud, robot.device) if key.startswith("action:")}
        again = anna.start(robot.device, once=f"k{after}", wait_ms=100, wait_for="done", **SHORT, **request_)
        assert again.status_code in {200, 202}, again.text
        if knife.written > 1:
            new = {key for key in rows(cloud, robot.device) if key.startswith("action:")} - before
            assert new == set(), "the same key is the same action, also after a kill"
        settled(cloud, anna, robot)
        end_last(anna, robot)
        if survived:
            assert after > 3
            return
    pytest.fail(f"a start writes more than {MOST_WRITES} times")


@pytest.mark.parametrize("reports", [SILENT, STARTS, ENDS], ids=["silent", "starts", "ends"])
def test_a_timer_killed_after_any_write_leaves_nothing_open(
    cloud: Cloud, pair: Pair, mortal: Mortal, reports: Callable[[Command], Answers]
) -> None:
    anna, robot = pair
    for after in range(1, MOST_WRITES):
        robot.reports = SILENT
        anna.start(robot.device, **SHORT)
        robot.reports = reports
        process, knife = mortal(cloud.clock)
        knife.left = after
        survived = True
        for _ in range(2 * (TIMEOUT_S + 4)):
            cloud.clock.advance(0.5)
            try:
                process.sweep()
            except Killed:
                survived = False
                break
        settled(cloud, anna, robot)
        end_last(anna, robot)
        if survived:
            return


def end_last(anna: Person, robot: Robot) -> None:
    """End the action by which ``settled`` saw that the device is free."""
    last = anna.get(f"/devices/{robot.device}/actions").json()["items"][0]["id"]
    robot.report(last, AckStatus.DONE)
    assert anna.action(last, wait_ms=10_000)["status"] == "done"


@pytest.mark.parametrize("after", range(4, 13))
def test_an_unpairing_killed_after_any_write_gives_the_robot_away_whole(
    cloud: Cloud, pair: Pair, mortal: Mortal, after: int
) -> None:
    anna, robot = pair
    anna.take(robot.device, lease_ms=600_000)
    anna.start(robot.device, wait_ms=10_000)
    process, knife = mortal(cloud.clock)
    there = elsewhere(process, anna)
    there.get("/accounts/me")
    knife.left = after
    there.delete(f"/agents/{robot.id}")
    assert anna.get(f"/devices/{robot.device}").status_code == 404
    bert = cloud.sign_in("bert")
    robot.pair(bert)
    robot.connect()
    wait_until(lambda: bert.get(f"/devices/{robot.device}").json()["online"], "the robot to be online")
    assert bert.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    assert bert.take(robot.device).json()["epoch"] >= 2
    assert bert.start(robot.device, wait_ms=10_000).status_code == 200
    assert bert.get(f"/devices/{robot.device}/actions").json()["items"][1:] == []


@pytest.mark.parametrize("after", range(1, 9))
def test_a_claim_killed_after_any_write_can_be_made_again_or_is_made(cloud: Cloud, mortal: Mortal, after: int) -> None:
    anna = cloud.sign_in("anna")
    robot = cloud.robot()
    code = robot.code()
    process, knife = mortal(cloud.clock)
    there = elsewhere(process, anna)
    there.get("/accounts/me")
    knife.left = after
    there.post("/agents/claim", {"code": code})
    if robot.enrollment()["state"] == "waiting":
        assert anna.get("/devices").json()["items"] == []
        assert anna.post("/agents/claim", {"code": code}).status_code == 200
    assert [item["id"] for item in anna.get("/devices").json()["items"]] == [robot.device]


def test_an_account_killed_after_any_write_is_completed(cloud: Cloud, mortal: Mortal) -> None:
    for after in range(1, 4):
        process, knife = mortal(cloud.clock)
        knife.left = after
        with pytest.raises(Killed):
            process.run(process.functions.sign_in.account(f"anna{after}"))
        anna = cloud.sign_in(f"anna{after}")
        assert len(anna.get("/spaces").json()["items"]) == 1
        assert cloud.run(cloud.functions.sign_in.named(anna.account)) == f"anna{after}"
