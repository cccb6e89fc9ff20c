"""Stop and its reset need no lease; Stop is published twice: unsigned to the control loop, and as a command."""

from collections.abc import Iterator
from typing import Any

import pytest

from device_agent.protocol import AckStatus, ResetStop, StopDevice, codec, topics
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import Cloud, Person, paired, problem
from tests.harness.network.brokers import Message

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
    assert [command.request for command in robot.received(StopDevice)] == [StopDevice(reason="smoke")]
    assert robot.received(ResetStop) == []
    assert elsewhere.post(f"/devices/{robot.device}/stop/reset").json() == {"confirmed": True}
    assert len(robot.received(ResetStop)) == 1
    reset, stop, _ = anna.get(f"/devices/{robot.device}/events").json()["items"]
    assert (reset["kind"], reset["data"]["caller"], reset["data"]["from"]) == ("stop-reset-ordered", "anna", "anna")
    assert (stop["kind"], stop["data"]) == ("stop-ordered", {"caller": "anna", "reason": "smoke"})
    assert stop["severity"] == "warning"


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
    assert anna.post(f"/devices/{robot.device}/stop/reset").json() == {"confirmed": False}


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


def test_without_a_broker_each_device_is_reported(anna: Person, robot: Robot, broker: MemoryBroker) -> None:
    broker.reachable = False
    answer = anna.post("/stop")
    assert answer.status_code == 207
    (item,) = answer.json()["items"]
    assert (item["device"], item["status"], item["outcome"]) == (robot.device, 503, "unreachable")
    assert item["problem"]["type"] == "/problems/broker-unavailable"
    answer = anna.post(f"/devices/{robot.device}/stop")
    assert problem(answer, 503, "broker-unavailable")["outcome"] == "unreachable"
