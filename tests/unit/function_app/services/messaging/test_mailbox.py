"""Commands for polling agents stay in the mailbox until they are acknowledged."""

from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, suppress
from typing import Any

import httpx
import pytest

from device_agent.protocol import (
    AckStatus,
    CancelAction,
    GrantLease,
    MoveJoints,
    ReleaseLease,
    RunMovement,
    StopDevice,
    codec,
    topics,
)
from function_app.domain.devices.devices import POLL_MARK_MS, POLL_SILENT_MS
from function_app.services.maintenance.scheduler import ORPHAN_MS
from function_app.services.messaging.command_sender import SHORT_TTL_MS, STOP_LIFETIME_MS
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fakes.broker_ports import MemoryCommandBus
from tests.fixtures.cloud import Crashing, OpenCloud
from tests.harness.cloud.cloud import Cloud, Person, paired, problem
from tests.harness.cloud.polling import PollingRobot
from tests.harness.crash_injection import Killed, at_instance

MINE = "/robot-types/ur5/movements/mine"
RUN_MINE = {"kind": "run_movement", "name": "mine"}


@pytest.fixture
def anna(cloud: Cloud) -> Person:
    return cloud.sign_in("anna")


@pytest.fixture
def robot(cloud: Cloud, anna: Person) -> Iterator[PollingRobot]:
    """A paired agent that has not polled yet."""
    with PollingRobot(cloud) as robot:
        robot.pair(anna)
        yield robot


def mailbox(cloud: Cloud, robot: PollingRobot) -> list[str]:
    page = cloud.run(cloud.functions.tables.query(records.MAILBOX, robot.id, limit=1000))
    return [row.key for row in page.rows]


def online(person: Person, robot: PollingRobot) -> bool:
    return bool(person.get(f"/devices/{robot.device}").json()["online"])


def test_lease_action_stop_and_reset_need_no_broker(open_cloud: OpenCloud) -> None:
    cloud = open_cloud()
    anna = cloud.sign_in("anna")
    with PollingRobot(cloud) as robot:
        robot.pair(anna)
        robot.open_link()
        assert online(anna, robot)

        def call(method: str, path: str, body: Any = None) -> httpx.Response:
            """A request that waits for the robot, which polls once meanwhile."""
            result = anna.begin(method, f"/devices/{robot.device}/{path}", json=body or {})
            robot.step()
            return result()

        anna.put(MINE, {"source": "robot.home()"})
        lease = call("POST", "lease", {"wait_ms": 10_000}).json()
        assert lease["confirmed"]
        parameters = {"note": 'grüß 🤖 " \\ \n'}
        run = {"request": {**RUN_MINE, "parameters": parameters}, "epoch": lease["epoch"], "wait_ms": 10_000}
        action = call("POST", "actions", run).json()
        assert action["status"] == "started"
        (command,) = robot.received(RunMovement)
        assert isinstance(command.request, RunMovement)
        assert command.request.parameters == parameters
        problem(anna.start(robot.device, epoch=lease["epoch"]), 409, "device-busy")
        robot.report(action["id"], AckStatus.DONE, result={"reached": True})
        final = anna.action(action["id"], wait_ms=10_000, wait_for="done")
        assert (final["status"], final["result"]) == ("done", {"reached": True})
        assert call("POST", "stop", {"reason": "look out"}).json()["outcome"] == "confirmed"
        assert call("POST", "stop/reset").json() == {"confirmed": True, "reason": None}
        problem(call("DELETE", f"lease?epoch={lease['epoch']}"), 409, "lease-lost")
        again = call("POST", "lease").json()["epoch"]
        assert call("DELETE", f"lease?epoch={again}").status_code == 204
        robot.step()
        assert robot.received(ReleaseLease)
        assert robot.stops == [], "only the signed Stop, which stays until it is acknowledged"
        assert [key for key in mailbox(cloud, robot) if not key.startswith("ack:")] == []
        assert all(len(payloads) == 1 for payloads in robot.payloads.values())


def test_a_rejected_command_is_not_confirmed(anna: Person, cloud: Cloud, robot: PollingRobot) -> None:
    result = anna.begin("POST", f"/devices/{robot.device}/lease", json={"wait_ms": 20_000})
    (item,) = robot.fetch()
    start_ms = cloud.clock.now_ms()
    robot.post_ack(item["id"], AckStatus.RECEIVED)
    robot.post_ack(item["id"], AckStatus.FAILED)
    assert result().json()["confirmed"] is False
    assert cloud.clock.now_ms() - start_ms < 10_000, "a rejection ends the wait"


def test_an_agent_that_returns_to_mqtt_gets_commands_there(anna: Person, robot: PollingRobot) -> None:
    robot.open_link()
    assert robot.enroll(transport="mqtt").status_code == 200
    Robot.connect(robot)
    assert anna.take_lease(robot.device, wait_ms=10_000).json()["confirmed"]
    assert len(robot.received(GrantLease)) == 1
    assert robot.fetch() == []


def test_a_command_is_delivered_again_with_the_same_bytes_until_it_is_acknowledged(
    cloud: Cloud, anna: Person, robot: PollingRobot
) -> None:
    assert robot.fetch() == []
    action = anna.start(robot.device).json()["id"]
    (first,) = robot.fetch()
    assert (first["id"], first["topic"]) == (action, robot.topic(topics.CMD))
    cloud.clock.advance(1.1)
    cloud.sweep()
    assert robot.fetch() == [first], "the timer resends it, but the mailbox contains it once"
    assert robot.fetch(have=[action]) == []
    assert robot.fetch(have=["another"]) == [first]
    assert robot.post_ack(action, AckStatus.RECEIVED) == {"status": "stored", "detail": None}
    assert robot.fetch() == []
    assert anna.action(action)["status"] == "received"


def test_stop_comes_first_then_the_oldest(cloud: Cloud, anna: Person, robot: PollingRobot) -> None:
    for _ in range(3):
        anna.take_lease(robot.device, wait_ms=0)
        cloud.clock.advance(0.01)
    anna.post(f"/devices/{robot.device}/stop")
    found = robot.fetch()
    assert [item["id"] for item in robot.fetch(limit=2)] == [item["id"] for item in found[:2]]
    requests = robot.read(found)
    assert [type(request) for request in requests] == [StopDevice, GrantLease, GrantLease, GrantLease]
    assert [command.epoch for command in robot.received(GrantLease)] == [1, 2, 3]


def test_an_expired_command_is_not_delivered_but_a_late_stop_is(
    cloud: Cloud, anna: Person, robot: PollingRobot
) -> None:
    anna.take_lease(robot.device, wait_ms=0)
    anna.post(f"/devices/{robot.device}/stop")
    cloud.clock.advance(SHORT_TTL_MS / 1000)
    assert [type(request) for request in robot.read(robot.fetch())] == [StopDevice]
    cloud.clock.advance((STOP_LIFETIME_MS - SHORT_TTL_MS) / 1000)
    assert robot.fetch() == []


def test_an_action_that_is_cancelled_before_the_first_poll_is_not_delivered(
    cloud: Cloud, anna: Person, robot: PollingRobot
) -> None:
    robot.fetch()
    action = anna.start(robot.device).json()["id"]
    assert anna.post(f"/actions/{action}/cancel").status_code == 202
    assert robot.read(robot.fetch()) == [CancelAction(action=action)]
    cloud.clock.advance(1.1)
    cloud.sweep()
    assert not any(isinstance(request, MoveJoints) for request in robot.read(robot.fetch()))


def test_entries_expire_when_the_agent_does_not_poll(cloud: Cloud, anna: Person, robot: PollingRobot) -> None:
    anna.take_lease(robot.device, wait_ms=100)
    anna.post(f"/devices/{robot.device}/stop")
    assert len(mailbox(cloud, robot)) == 4, "two commands, and an entry for each ack"
    cloud.clock.advance(3600)
    for _ in range(3):
        cloud.sweep()
    assert mailbox(cloud, robot) == []


@pytest.mark.parametrize("character", ['"', "\\", "ü"])
def test_a_command_of_any_length_and_alphabet_fits(anna: Person, robot: PollingRobot, character: str) -> None:
    robot.fetch()
    assert anna.put(MINE, {"source": "#" + character * 45_000}).status_code == 201
    assert anna.start(robot.device, request=RUN_MINE).status_code == 202
    (request,) = robot.read(robot.fetch())
    assert character * 45_000 in request.source


def test_commands_are_delivered_in_pages_of_bounded_size(anna: Person, cloud: Cloud) -> None:
    with PollingRobot(cloud, *(f"arm{number}" for number in range(12))) as robot:
        robot.pair(anna)
        robot.fetch()
        assert anna.put(MINE, {"source": "#" + "ü" * 48_000}).status_code == 201
        started = [anna.start(device, request=RUN_MINE).json()["id"] for device in robot.devices]
        first = [item["id"] for item in robot.fetch(limit=32)]
        second = [item["id"] for item in robot.fetch(limit=32, have=first)]
        assert len(first) == 10, "a response has at most about one megabyte"
        assert sorted(first + second) == sorted(started)


@pytest.mark.parametrize("instance", ["same", "another"])
def test_a_long_poll_ends_when_a_command_arrives(
    cloud: Cloud, open_cloud: OpenCloud, anna: Person, robot: PollingRobot, instance: str
) -> None:
    headers = {"Authorization": f"Bearer {robot.token()}"}
    url = f"/api/v1/agents/{robot.id}/commands?wait_ms=30000"
    poll = cloud.begin(cloud.client().get(url, headers=headers))
    start_ms = cloud.clock.now_ms()
    person = anna if instance == "same" else at_instance(open_cloud(clock=cloud.clock), anna)
    action = person.start(robot.device).json()["id"]
    assert [item["id"] for item in poll().json()["items"]] == [action]
    assert cloud.clock.now_ms() - start_ms < 10_000


def test_a_long_poll_without_commands_ends_in_time(cloud: Cloud, robot: PollingRobot) -> None:
    start_ms = cloud.clock.now_ms()
    assert robot.fetch(wait_ms=300) == []
    assert cloud.clock.now_ms() - start_ms >= 300


def test_a_polling_agent_is_online_and_its_last_poll_is_written_at_intervals(
    cloud: Cloud, anna: Person, robot: PollingRobot
) -> None:
    def mark() -> object:
        return cloud.run(cloud.functions.tables.get(records.AGENTS, robot.id, "link"))

    assert not online(anna, robot)
    robot.fetch()
    assert online(anna, robot)
    first = mark()
    for _ in range(5):
        robot.fetch()
        robot.post_raw((robot.topic(topics.ACK), b"{}"))
    assert mark() == first
    cloud.clock.advance(POLL_MARK_MS / 1000)
    robot.fetch()
    assert mark() != first


@pytest.mark.parametrize("reason", ["silent", "goodbye"])
def test_an_agent_that_stops_polling_is_offline_until_the_next_poll(
    cloud: Cloud, anna: Person, robot: PollingRobot, reason: str
) -> None:
    robot.open_link()
    if reason == "silent":
        cloud.clock.advance(POLL_SILENT_MS / 1000 + 1)
    else:
        robot.publish_presence(online=False)
    assert not online(anna, robot)
    problem(anna.start(robot.device), 409, "device-offline")
    robot.fetch()
    assert online(anna, robot)
    assert anna.start(robot.device).status_code == 202


def test_without_acks_on_the_bus_a_confirmation_is_read_from_the_tables(
    cloud: Cloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With IoT Core and Event Grid the bus only publishes; acks arrive at the ingest, perhaps of another instance."""

    @asynccontextmanager
    async def no_acks(*_: object) -> AsyncIterator[None]:
        yield None

    monkeypatch.setattr(MemoryCommandBus, "acks", no_acks)
    with paired(cloud) as (anna, robot):
        assert anna.take_lease(robot.device, wait_ms=20_000).json()["confirmed"]
        assert anna.start(robot.device, wait_ms=20_000).json()["status"] == "started"
        robot.silent = True
        assert anna.take_lease(robot.device, wait_ms=300).json()["confirmed"] is False


# ------------------------------------------------------------ processes that are killed between two writes

MOST_WRITES = 80
TTL_S, TIMEOUT_S = 2, 6
SHORT = {"ttl_ms": TTL_S * 1000, "timeout_ms": TIMEOUT_S * 1000}


def pass_time(cloud: Cloud, robot: PollingRobot, seconds: float, step_s: float = 0.5) -> None:
    """Advance time and run the timer while the robot polls and acknowledges receipt only."""
    for _ in range(round(seconds / step_s)):
        cloud.clock.advance(step_s)
        cloud.sweep()
        for item in robot.fetch():
            robot.read([item])
            robot.post_ack(item["id"], AckStatus.RECEIVED)


def check_settled(cloud: Cloud, anna: Person, robot: PollingRobot) -> None:
    """Nothing is left open, each action ran at most once, and the device is free."""
    pass_time(cloud, robot, TIMEOUT_S + 4)
    pass_time(cloud, robot, ORPHAN_MS / 1000 + 31, step_s=31)
    anna = cloud.sign_in("anna")
    page = cloud.run(cloud.functions.tables.query(records.CONTROL, robot.device, first="action:", last="action;"))
    ended = {row.data["id"]: row.data["status"] for row in page.rows}
    assert set(ended.values()) <= {"done", "failed", "expired", "cancelled", "unknown"}
    for action, status in ended.items():
        if status == "unknown":
            robot.post_ack(action, AckStatus.DONE)
            assert anna.action(action)["status"] == "done"
    for action, payloads in robot.payloads.items():
        assert len(set(payloads)) == 1, "the same command has the same bytes"
        request = next(command.request for command in robot.commands if command.id == action)
        assert action in ended or not isinstance(request, MoveJoints), "no command is sent without its row"
    assert robot.fetch() == []
    free = anna.start(robot.device).json()["id"]
    assert [item["id"] for item in robot.fetch()] == [free]
    robot.post_ack(free, AckStatus.DONE)
    assert anna.action(free)["status"] == "done"


@pytest.mark.slow
def test_a_start_killed_after_any_write_reaches_the_robot_or_ends(
    cloud: Cloud, robot: PollingRobot, crashing: Crashing
) -> None:
    robot.fetch()
    repaired = 0
    for after in range(1, MOST_WRITES):
        anna = cloud.sign_in("anna")
        process, crash = crashing(cloud.clock)
        caller = at_instance(process, anna)
        assert caller.get("/accounts/me").status_code == 200
        crash.left = after
        answer = caller.start(robot.device, idempotency_key=f"k{after}", **SHORT)
        survived = crash.left > 0
        assert (answer.status_code < 500) is survived
        actions = anna.get(f"/devices/{robot.device}/actions").json()["items"]
        unsent = [item["id"] for item in actions if item["status"] in {"created", "published"}]
        if unsent and not mailbox(cloud, robot):
            cloud.clock.advance(1.1)
            cloud.sweep()
            assert [item["id"] for item in robot.fetch()] == unsent
            repaired += 1
        check_settled(cloud, anna, robot)
        if survived:
            assert repaired, "one kill was between the row and the mailbox"
            return
    pytest.fail(f"a start writes more than {MOST_WRITES} times")


def test_an_ack_killed_after_any_write_is_repeated_and_applied_once(
    cloud: Cloud, anna: Person, robot: PollingRobot, crashing: Crashing
) -> None:
    robot.fetch()
    for after in range(1, MOST_WRITES):
        action = anna.start(robot.device).json()["id"]
        (item,) = robot.fetch()
        process, crash = crashing(cloud.clock)
        sender = PollingRobot(process)
        sender.key, sender.id = robot.key, robot.id
        message = (robot.topic(topics.ACK), codec.encode(robot.ack(action, AckStatus.DONE)))
        crash.left = after
        answer = sender.post_raw(message)
        survived = crash.left > 0
        assert (answer.status_code == 200) is survived
        if anna.action(action)["status"] != "done":
            assert robot.fetch() == [item], "the command is delivered again until its result is stored"
        assert robot.post_raw(message).status_code == 200
        assert robot.fetch() == []
        assert anna.action(action)["status"] == "done"
        if survived:
            assert after > 1, "the action, and the mailbox"
            return
    pytest.fail(f"an ack writes more than {MOST_WRITES} times")


@pytest.mark.slow
def test_a_timer_killed_after_any_write_leaves_nothing_open(
    cloud: Cloud, robot: PollingRobot, crashing: Crashing
) -> None:
    robot.fetch()
    for after in range(1, MOST_WRITES):
        anna = cloud.sign_in("anna")
        anna.start(robot.device, **SHORT)
        process, crash = crashing(cloud.clock)
        crash.left = after
        with suppress(Killed):
            for _ in range(2 * (TIMEOUT_S + 4)):
                cloud.clock.advance(0.5)
                process.sweep()
        survived = crash.left > 0
        check_settled(cloud, anna, robot)
        if survived:
            return
    pytest.fail(f"a timer writes more than {MOST_WRITES} times")
