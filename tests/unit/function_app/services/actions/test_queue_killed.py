"""Processes killed after any write leave a queue that the timer completes."""

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from device_agent.protocol import AckStatus, Command, codec
from function_app.services.actions.queue import LOOK_MS
from function_app.services.maintenance.scheduler import ORPHAN_MS
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fixtures.cloud import Mortal
from tests.harness.cloud.cloud import Cloud, Person
from tests.harness.crash_injection import Killed, elsewhere
from tests.unit.function_app.services.actions.queue_requests import (
    ENDED,
    QUEUE,
    Pair,
    deliver_ack,
    notes,
    pass_time,
    queued,
    reason,
    sent,
)

MOST_WRITES = 16
SHORT: dict[str, Any] = {"ttl_ms": 2_000, "timeout_ms": 6_000}


def settled(cloud: Cloud, robot: Robot, anna: Person) -> dict[str, dict[str, Any]]:
    """Let time pass and see that nothing is left open; gives the actions, oldest first."""
    pass_time(cloud, 20, step_s=0.5)
    pass_time(cloud, 10 + ORPHAN_MS / 1000, step_s=15)
    pass_time(cloud, 400, step_s=200)
    page = cloud.run(cloud.functions.tables.query(records.CONTROL, robot.device, limit=1000))
    rows = {row.key: dict(row.data) for row in page.rows}
    actions = {data["id"]: data for key, data in reversed(rows.items()) if key.startswith("action:")}
    assert {data["status"] for data in actions.values()} <= ENDED, actions
    assert rows["now:slot"]["action"] == ""
    queue = rows.get("now:queue", {"actions": [], "dropped": {}})
    assert (list(queue["actions"]), dict(queue["dropped"])) == ([], {})
    assert notes(cloud) == []
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    for action in sent(robot):
        assert action in actions, "nothing runs that is not written"
        assert len(set(robot.payloads[action])) == 1
    return actions


def starts(_: Command) -> tuple[AckStatus, ...]:
    return (AckStatus.RECEIVED, AckStatus.STARTED)


def ends(_: Command) -> tuple[AckStatus, ...]:
    return (AckStatus.RECEIVED, AckStatus.STARTED, AckStatus.DONE)


def killed(mortal: Mortal, cloud: Cloud, anna: Person, after: int, work: Callable[[Cloud, Person], object]) -> bool:
    """Do ``work`` in a process that is killed after so many writes; whether it survived."""
    process, knife = mortal(cloud.clock)
    there = elsewhere(process, anna)
    assert there.get("/accounts/me").status_code == 200
    knife.left = after
    with contextlib.suppress(Killed):
        work(process, there)
    return knife.left > 0


def test_a_start_that_waits_killed_after_any_write_leaves_nothing_open(
    cloud: Cloud, pair: Pair, mortal: Mortal
) -> None:
    _, robot = pair
    for after in range(1, MOST_WRITES):
        anna = cloud.sign_in("anna")
        robot.reports = starts
        first = anna.start(robot.device, wait_ms=10_000, **SHORT).json()["id"]
        robot.reports = ends
        ask = partial(lambda key, _, there: there.start(robot.device, once=key, **QUEUE, **SHORT), f"k{after}")
        survived = killed(mortal, cloud, anna, after, ask)
        robot.report(first, AckStatus.DONE)
        for item in anna.get(f"/devices/{robot.device}/actions").json()["items"]:
            anna.action(item["id"], wait_ms=20_000)
        actions = settled(cloud, robot, anna)
        assert actions[first]["status"] == "done"
        for action, data in actions.items():
            assert data["status"] == "done", (after, action, data)
        if survived:
            assert after > 3
            return
    pytest.fail(f"a start writes more than {MOST_WRITES} times")


@pytest.mark.parametrize("last", [AckStatus.DONE, AckStatus.FAILED])
def test_who_ends_an_action_killed_after_any_write_leaves_the_queue_to_the_timer(
    cloud: Cloud, pair: Pair, mortal: Mortal, last: AckStatus
) -> None:
    _, robot = pair
    for after in range(1, MOST_WRITES):
        anna = cloud.sign_in("anna")
        robot.reports = starts
        first = anna.start(robot.device, wait_ms=10_000, **SHORT).json()["id"]
        waiting = [queued(anna, robot.device, **SHORT) for _ in range(2)]
        pass_time(cloud, 2)  # the timer has seen that they wait
        robot.reports = ends
        ack = codec.encode(robot.ack(first, last))
        survived = killed(
            mortal, cloud, anna, after, partial(lambda ack, process, _: deliver_ack(process, robot, ack), ack)
        )
        pass_time(cloud, LOOK_MS / 1000 + 1)
        for action in waiting:
            anna.action(action, wait_ms=20_000)
        actions = settled(cloud, robot, anna)
        assert actions[first]["status"] == last.value
        assert {actions[action]["status"] for action in waiting} == {
            "done" if last is AckStatus.DONE else "cancelled"
        }, after
        if survived:
            assert after > 2
            return
    pytest.fail(f"an end writes more than {MOST_WRITES} times")


def test_a_timer_killed_after_any_write_leaves_nothing_open(cloud: Cloud, pair: Pair, mortal: Mortal) -> None:
    _, robot = pair

    def work(process: Cloud, _: Person) -> None:
        for _round in range(12):
            cloud.clock.advance(1)
            process.sweep()

    for after in range(1, 60, 3):
        anna = cloud.sign_in("anna")
        robot.reports = starts
        anna.start(robot.device, wait_ms=10_000, **SHORT)
        robot.reports = ends
        queued(anna, robot.device, queue_ms=3_000, **SHORT)
        queued(anna, robot.device, **SHORT)
        survived = killed(mortal, cloud, anna, after, work)
        settled(cloud, robot, anna)
        if survived:
            return
    pytest.fail("the timer writes more often than that")


def test_a_stop_killed_after_any_write_leaves_nothing_open(cloud: Cloud, pair: Pair, mortal: Mortal) -> None:
    _, robot = pair
    for after in range(1, MOST_WRITES):
        anna = cloud.sign_in("anna")
        robot.reports = starts
        first = anna.start(robot.device, wait_ms=10_000, **SHORT).json()["id"]
        waiting = [queued(anna, robot.device, **SHORT) for _ in range(2)]
        survived = killed(mortal, cloud, anna, after, lambda _, there: there.post(f"/devices/{robot.device}/stop"))
        pass_time(cloud, LOOK_MS / 1000 + 1)
        assert {reason(anna, action) for action in waiting} == {("cancelled", "stopped")}
        robot.fail(first, "stopped", "The device was stopped.")
        settled(cloud, robot, anna)
        assert not set(waiting) & set(sent(robot))
        if survived:
            return
    pytest.fail(f"a stop writes more than {MOST_WRITES} times")
