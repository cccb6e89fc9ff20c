"""Stop and its reset need no lease; Stop is published twice: unsigned to the control loop, and as a command."""

import asyncio
from collections.abc import Iterator
from typing import Any
from unittest import mock

import pytest

from device_agent.protocol import AckStatus, ResetStop, StopDevice, codec, topics
from function_app.domain.identity.accounts import Identity
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.monitoring import Counter
from function_app.services.actions.stop import StopOutcome, StopResult
from function_app.services.control.lease_store import LeaseStore
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import Cloud, Person, paired, problem
from tests.harness.network.brokers import Message
from tests.unit.function_app.services.sharing.shares import share

TwoRooms = tuple[Person, Robot, Robot, str]


def outcomes(answer: Any) -> dict[str, str]:
    assert all(item["confirmed"] == (item["outcome"] == "confirmed") for item in answer.json()["items"])
    return {item["device"]: item["outcome"] for item in answer.json()["items"]}


def outcome(answer: Any) -> tuple[int, str]:
    return answer.status_code, answer.json()["outcome"]


def test_stop_and_reset_are_sent_and_recorded(anna: Person, robot: Robot) -> None:
    anna.take_lease(robot.device)
    elsewhere = anna.cloud.sign_in("anna")
    answer = elsewhere.post(f"/devices/{robot.device}/stop", {"reason": "smoke"})
    assert outcome(answer) == (200, "confirmed")
    assert robot.stops[0].reason == "smoke"
    (command,) = robot.received(StopDevice)
    assert (command.request, command.epoch, command.caller) == (StopDevice(reason="smoke"), 0, "anna")
    assert command.id == robot.stops[0].id, "the device applies it once"
    assert robot.received(ResetStop) == []
    assert elsewhere.post(f"/devices/{robot.device}/stop/reset").json() == {"confirmed": True, "reason": None}
    assert len(robot.received(ResetStop)) == 1
    reset, stop, _ = anna.get(f"/devices/{robot.device}/events").json()["items"]
    assert (reset["kind"], reset["data"]["caller"], reset["data"]["from"]) == ("stop-reset-ordered", "anna", "anna")
    assert (stop["kind"], stop["data"]) == ("stop-ordered", {"caller": "anna", "reason": "smoke"})
    assert (stop["severity"], stop["id"]) == ("warning", command.id)
    assert all(text in stop["message"] for text in ("anna", "smoke"))
    elsewhere.post(f"/devices/{robot.device}/stop")
    without, *_ = anna.get(f"/devices/{robot.device}/events").json()["items"]
    assert (without["data"]["reason"], without["message"].count(":")) == ("", 0)


def test_each_reset_begins_a_new_epoch(anna: Person, robot: Robot) -> None:
    epoch = anna.take_lease(robot.device).json()["epoch"]
    anna.post(f"/devices/{robot.device}/stop")
    anna.post(f"/devices/{robot.device}/stop/reset")
    problem(anna.take_lease(robot.device, epoch=epoch), 409, "lease-lost")
    problem(anna.start(robot.device, epoch=epoch), 409, "lease-lost")
    anna.post(f"/devices/{robot.device}/stop/reset")
    assert [command.epoch for command in robot.received(ResetStop)] == [epoch + 1, epoch + 2]
    assert anna.take_lease(robot.device).json()["epoch"] == epoch + 3


def test_the_unsigned_message_is_repeated_until_confirmed(anna: Person, robot: Robot) -> None:
    robot.silent = True
    assert outcome(anna.post(f"/devices/{robot.device}/stop")) == (202, "sent")
    assert len(robot.stops) >= 3
    assert len({stop.id for stop in robot.stops}) == 1
    assert anna.post(f"/devices/{robot.device}/stop/reset").json() == {"confirmed": False, "reason": None}


def test_an_offline_robot_receives_stop(anna: Person, robot: Robot) -> None:
    robot.publish_presence(online=False)
    problem(anna.post(f"/devices/{robot.device}/stop", {"reason": "x" * 2001}), 422, "invalid")
    assert robot.stops == []
    assert outcome(anna.post(f"/devices/{robot.device}/stop", {"reason": "🛑" * 2000})) == (200, "confirmed")
    robot.silent = True
    assert outcome(anna.post(f"/devices/{robot.device}/stop")) == (202, "unreachable")


@pytest.mark.parametrize("first", [AckStatus.RECEIVED, AckStatus.FAILED])
def test_only_the_ack_of_the_control_loop_confirms(anna: Person, robot: Robot, first: AckStatus) -> None:
    def hang(message: Message) -> None:
        before = len(robot.commands)
        robot.silent = True
        Robot.handle(robot, message)
        for command in robot.commands[before:]:
            assert robot.link is not None
            robot.link.publish(robot.topic(topics.ACK), codec.encode(robot.ack(command.id, first)))

    robot.handle = hang  # type: ignore[method-assign]
    assert outcome(anna.post(f"/devices/{robot.device}/stop")) == (202, "sent")


@pytest.fixture
def two_rooms(cloud: Cloud) -> Iterator[TwoRooms]:
    """Anna with two arms in her first space, and one in the lab."""
    with paired(cloud, "anna", "left", "right") as (anna, first), cloud.robot() as second:
        lab = anna.post("/spaces", {"name": "Lab"}).json()["id"]
        second.pair(anna)
        assert anna.put(f"/agents/{second.id}/space", {"space": lab}).status_code == 200
        second.space = lab
        second.connect()
        yield anna, first, second, lab


def test_all_devices_of_a_space_are_stopped_and_no_others(two_rooms: TwoRooms) -> None:
    anna, first, second, lab = two_rooms
    answer = anna.post(f"/spaces/{first.space}/stop", {"reason": "smoke"})
    assert (answer.status_code, outcomes(answer)) == (200, dict.fromkeys(first.devices, "confirmed"))
    assert sorted(command.device for command in first.received(StopDevice)) == ["left", "right"]
    assert {stop.reason for stop in first.stops} == {"smoke"}
    assert not second.commands
    assert not second.stops
    assert outcomes(anna.post(f"/spaces/{lab}/stop")) == {second.device: "confirmed"}
    problem(anna.post("/spaces/nowhere/stop"), 404, "space-unknown")


def test_all_devices_of_the_account_are_stopped_and_no_others(cloud: Cloud, two_rooms: TwoRooms) -> None:
    anna, first, second, _ = two_rooms
    with paired(cloud, "bert") as (bert, other):
        answer = anna.post("/stop")
        assert (answer.status_code, outcomes(answer)) == (
            200,
            dict.fromkeys([*first.devices, second.device], "confirmed"),
        )
        assert not other.commands
        assert not other.stops
        assert outcomes(bert.post("/stop")) == {other.device: "confirmed"}
    assert cloud.sign_in("clara").post("/stop").json() == {"items": []}


def test_an_unresponsive_device_delays_no_other_and_is_named(two_rooms: TwoRooms) -> None:
    anna, first, second, _ = two_rooms
    waiting = [anna.start(first.device, policy="queue", wait_ms=0).json()["id"] for _ in range(3)]
    second.silent = True
    call = anna.begin("POST", "/stop")
    assert len(first.received(StopDevice)) == 2
    answer = call()
    assert answer.status_code == 207
    assert outcomes(answer) == {**dict.fromkeys(first.devices, "confirmed"), second.device: "sent"}
    assert len(second.stops) >= 3, "repeated until the time limit"
    assert [anna.action(action)["status"] for action in waiting[1:]] == ["cancelled"] * 2
    events = anna.get(f"/devices/{second.device}/events").json()["items"]
    assert [item["kind"] for item in events if item["kind"].startswith("stop")] == ["stop-ordered"]


def test_a_rejected_reset_names_the_reason_of_the_device(anna: Person, robot: Robot) -> None:
    message = "the device has stopped itself: protective stop"
    robot.silent = True
    call = anna.begin("POST", f"/devices/{robot.device}/stop/reset")
    (command,) = robot.received(ResetStop)
    robot.fail(command.id, "device_stopped", message)
    assert call().json() == {"confirmed": False, "reason": {"code": "device_stopped", "message": message}}


def test_without_a_broker_each_device_is_reported(anna: Person, robot: Robot, broker: MemoryBroker) -> None:
    broker.reachable = False
    answer = anna.post("/stop")
    assert answer.status_code == 207
    (item,) = answer.json()["items"]
    assert (item["device"], item["status"], item["outcome"]) == (robot.device, 503, "unreachable")
    assert item["problem"]["type"] == "/problems/broker-unavailable"
    answer = anna.post(f"/devices/{robot.device}/stop")
    assert problem(answer, 503, "broker-unavailable")["outcome"] == "unreachable"


def test_a_viewer_may_stop_a_space_only_where_it_operates(two_rooms: TwoRooms, bert: Person) -> None:
    anna, first, second, lab = two_rooms
    problem(bert.post(f"/spaces/{lab}/stop"), 404, "space-unknown")
    share(anna, f"spaces/{lab}", bert, "viewer")
    problem(bert.post(f"/spaces/{lab}/stop"), 403, "forbidden")
    assert (second.stops, second.commands) == ([], [])
    share(anna, f"devices/{second.device}", bert, "operator")
    assert outcomes(bert.post(f"/spaces/{lab}/stop")) == {second.device: "confirmed"}
    assert (first.stops, first.commands) == ([], [])


def test_stop_of_an_own_empty_space_stops_nothing(anna: Person, robot: Robot) -> None:
    attic = anna.post("/spaces", {"name": "Attic"}).json()["id"]
    answer = anna.post(f"/spaces/{attic}/stop")
    assert (answer.status_code, answer.json()) == (200, {"items": []})
    assert robot.stops == []


@pytest.mark.parametrize(("path", "wanted"), [("stop", "stop"), ("stop/reset", "reset Stop")])
def test_a_refused_stop_or_reset_is_recorded(anna: Person, bert: Person, robot: Robot, path: str, wanted: str) -> None:
    share(anna, f"devices/{robot.device}", bert, "viewer")
    problem(bert.post(f"/devices/{robot.device}/{path}"), 403, "forbidden")
    assert (robot.stops, robot.commands) == ([], [])
    event, *_ = anna.get(f"/devices/{robot.device}/events").json()["items"]
    assert event["kind"] == "command-rejected"
    assert event["data"] == {"caller": "bert", "wanted": wanted, "code": "forbidden"}


def test_the_first_reset_has_the_first_epoch(anna: Person, robot: Robot) -> None:
    anna.post(f"/devices/{robot.device}/stop/reset")
    assert [command.epoch for command in robot.received(ResetStop)] == [1]


def test_no_reset_is_sent_for_a_share_that_ended_meanwhile(
    cloud: Cloud, anna: Person, bert: Person, robot: Robot
) -> None:
    share(anna, f"devices/{robot.device}", bert, "operator")
    store = cloud.functions.lease_store

    async def change(*arguments: Any, **options: Any) -> Any:
        changed = await LeaseStore.change(store, *arguments, **options)
        tables = cloud.functions.tables
        await records.remove(tables, records.SHARES, f"device:{robot.device}", f"account:{bert.account}")
        return changed

    with mock.patch.object(store, "change", change):
        problem(bert.post(f"/devices/{robot.device}/stop/reset"), 404, "device-unknown")
    assert robot.received(ResetStop) == []


def test_the_unsigned_message_names_the_account_and_is_repeated_after_a_failure(
    anna: Person, robot: Robot, broker: MemoryBroker
) -> None:
    robot.silent = True
    publish = broker.publish
    published: list[str] = []

    def failing(topic: str, payload: bytes, **options: Any) -> None:
        published.append(topic)
        if len(published) == 1:
            raise BusUnavailable("the broker did not confirm the message")
        publish(topic, payload, **options)

    with mock.patch.object(broker, "publish", failing):
        assert outcome(anna.post(f"/devices/{robot.device}/stop")) == (202, "sent")
    assert published[0] == robot.topic(f"{topics.STOP}/{anna.account}"), "before the signed command"
    assert len(robot.stops) >= 3
    assert len(robot.received(StopDevice)) == 1


@pytest.mark.parametrize("slow", ["queue", "message"])
def test_the_result_is_returned_after_the_queue_was_cancelled_and_the_last_message_was_sent(
    cloud: Cloud, anna: Person, robot: Robot, slow: str
) -> None:
    """A message that is sent after a reset would latch Stop again."""
    finished: set[str] = set()

    async def finish(part: str) -> None:
        if part == slow:
            await asyncio.sleep(0.5)
        finished.add(part)

    async def send(*_: Any) -> None:
        try:
            await asyncio.sleep(60)
        finally:
            await finish("message")

    async def cancel(device: str, why: str) -> None:
        assert (device, why) == (robot.device, "stopped")
        await finish("queue")

    async def stop() -> tuple[StopResult, set[str]]:
        caller = Identity(anna.account, anna.name, anna.session)
        return await cloud.functions.stop.stop(caller, robot.device, ""), set(finished)

    with (
        mock.patch.object(cloud.functions.queues, "cancel_all", cancel),
        mock.patch.object(cloud.functions.delivery, "stop", send),
    ):
        result = cloud.run(stop())
    assert result == (StopResult(robot.device, StopOutcome.CONFIRMED), {"queue", "message"})


def test_outcomes_are_counted(cloud: Cloud, anna: Person, robot: Robot) -> None:
    counted: list[tuple[Counter, str]] = []
    with mock.patch.object(cloud.functions.metrics, "count", lambda *measured: counted.append(measured)):
        anna.post(f"/devices/{robot.device}/stop")
        robot.silent = True
        anna.post("/stop")
    assert [outcome for counter, outcome in counted if counter is Counter.STOPS] == ["confirmed", "sent"]
