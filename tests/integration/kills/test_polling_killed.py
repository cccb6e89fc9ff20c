"""Processes killed between two writes, with an agent that polls: nothing is lost, nothing runs twice, nothing stays."""

import functools
from collections.abc import Callable, Iterator

import pytest

from device_agent.protocol import AckStatus, MoveJoints, RunMovement, codec, topics
from function_app.services.maintenance.scheduler import ORPHAN_MS
from function_app.services.storage import records
from tests.fakes.clock import MovingClock
from tests.harness.cloud.cloud import Cloud, Person
from tests.harness.cloud.polling import PollingRobot
from tests.harness.crash_injection import Killed, Knife, elsewhere
from tests.harness.network.brokers import wait_until

Mortal = Callable[[MovingClock], tuple[Cloud, Knife]]
TTL_S, TIMEOUT_S = 2, 6
SHORT = {"ttl_ms": TTL_S * 1000, "timeout_ms": TIMEOUT_S * 1000}
MOST_WRITES = 20


@pytest.fixture
def anna(cloud: Cloud) -> Person:
    return cloud.sign_in("anna")


@pytest.fixture
def robot(cloud: Cloud, anna: Person) -> Iterator[PollingRobot]:
    with PollingRobot(cloud) as robot:
        robot.pair(anna)
        robot.fetch()
        yield robot


def letters(cloud: Cloud, robot: PollingRobot) -> list[str]:
    page = cloud.run(cloud.functions.tables.query(records.MAILBOX, robot.id, first="0", last="2"))
    return [row.key for row in page.rows]


def pass_time(cloud: Cloud, robot: PollingRobot, seconds: float, step_s: float = 0.5) -> None:
    """Advance time and run the timer while the robot polls and acknowledges receipt only."""
    while seconds > 0:
        cloud.clock.advance(step_s)
        seconds -= step_s
        cloud.sweep()
        for item in robot.fetch():
            robot.read([item])
            robot.tell_ack(item["id"], AckStatus.RECEIVED)


def settled(cloud: Cloud, anna: Person, robot: PollingRobot) -> None:
    """Nothing is left open, each action ran at most once, and the device is free."""
    pass_time(cloud, robot, TIMEOUT_S + 4)
    pass_time(cloud, robot, ORPHAN_MS / 1000 + 2, step_s=31)
    page = cloud.run(cloud.functions.tables.query(records.CONTROL, robot.device, first="action:", last="action;"))
    ended = {row.data["id"]: row.data["status"] for row in page.rows}
    assert set(ended.values()) <= {"done", "failed", "expired", "cancelled"}
    for action, payloads in robot.payloads.items():
        assert len(set(payloads)) == 1, "the same command has the same bytes"
        request = next(command.request for command in robot.commands if command.id == action)
        assert action in ended or not isinstance(request, MoveJoints | RunMovement), "nothing runs that is not written"
    assert robot.fetch() == []
    free = anna.start(robot.device).json()["id"]
    assert [item["id"] for item in robot.fetch()] == [free]
    robot.tell_ack(free, AckStatus.DONE)
    assert anna.action(free)["status"] == "done"


def test_a_start_killed_after_any_write_reaches_the_robot_or_ends(
    cloud: Cloud, anna: Person, robot: PollingRobot, mortal: Mortal
) -> None:
    mended = 0
    for after in range(1, MOST_WRITES):
        process, knife = mortal(cloud.clock)
        there = elsewhere(process, anna)
        assert there.get("/accounts/me").status_code == 200
        knife.left = after
        answer = there.start(robot.device, once=f"k{after}", **SHORT)
        survived = knife.left > 0
        assert (answer.status_code < 500) is survived
        found = anna.get(f"/devices/{robot.device}/actions").json()["items"]
        open_now = [item["id"] for item in found if item["status"] in {"created", "published"}]
        if open_now and not letters(cloud, robot):
            # Written, and killed before it was put into the mailbox.
            cloud.clock.advance(1.1)
            cloud.sweep()
            assert [item["id"] for item in robot.fetch()] == open_now
            mended += 1
        settled(cloud, anna, robot)
        if survived:
            assert mended, "one of the kills was between the two"
            return
    pytest.fail(f"a start writes more than {MOST_WRITES} times")


def test_an_ack_killed_after_any_write_is_told_again_and_counts_once(
    cloud: Cloud, anna: Person, robot: PollingRobot, mortal: Mortal
) -> None:
    for after in range(1, MOST_WRITES):
        action = anna.start(robot.device).json()["id"]
        (item,) = robot.fetch()
        process, knife = mortal(cloud.clock)
        there = PollingRobot(process)
        there.key, there.id = robot.key, robot.id
        message = (robot.topic(topics.ACK), codec.encode(robot.ack(action, AckStatus.DONE)))
        knife.left = after
        answer = there.tell_raw(message)
        survived = knife.left > 0
        assert (answer.status_code == 200) is survived
        if anna.action(action)["status"] != "done":
            assert robot.fetch() == [item], "the command is delivered again until its result is stored"
        assert robot.tell_raw(message).status_code == 200
        assert robot.fetch() == []
        assert anna.action(action)["status"] == "done"
        if survived:
            assert after > 1, "the action, and the mailbox"
            return
    pytest.fail(f"an ack writes more than {MOST_WRITES} times")


def test_a_timer_killed_after_any_write_leaves_nothing_open(
    cloud: Cloud, anna: Person, robot: PollingRobot, mortal: Mortal
) -> None:
    for after in range(1, MOST_WRITES):
        anna.start(robot.device, **SHORT)
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
        if survived:
            return


def _empty(cloud: Cloud, robot: PollingRobot) -> bool:
    return letters(cloud, robot) == []


def test_many_robots_that_ask_and_many_callers_at_once(cloud: Cloud, anna: Person) -> None:
    """Each command is obeyed once by the one robot it is for."""
    robots = [PollingRobot(cloud, wait_ms=wait_ms) for wait_ms in (0, 300, 0, 300)]
    try:
        for robot in robots:
            robot.reports = lambda _: (AckStatus.RECEIVED, AckStatus.STARTED, AckStatus.DONE)
            robot.pair(anna)
            robot.connect()
        for _ in range(3):
            calls = [
                anna.begin(
                    "POST",
                    f"/devices/{robot.device}/actions",
                    json={
                        "request": {"kind": "move_joints", "position_rad": {"elbow": 1.0}},
                        "wait_ms": 20_000,
                        "wait_for": "done",
                    },
                )
                for robot in robots
            ]
            assert [call().json()["status"] for call in calls] == ["done"] * len(robots)
        for robot in robots:
            moves = robot.heard(MoveJoints)
            assert len(moves) == len({command.id for command in moves}) == 3
        for robot in robots:
            wait_until(functools.partial(_empty, cloud, robot), "an empty mailbox")
    finally:
        for robot in robots:
            robot.__exit__()
