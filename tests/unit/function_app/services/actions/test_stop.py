"""Stop and its reset: two ways out, no lease asked for."""

from collections.abc import Iterator
from typing import Any

import pytest

from device_agent.protocol import ResetStop, StopDevice
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import Cloud, Person, paired, problem
from tests.harness.network.brokers import wait_until

Pair = tuple[Person, Robot]


def test_stop_goes_out_plain_and_signed_and_reset_signed(pair: Pair) -> None:
    anna, robot = pair
    answer = anna.post(f"/devices/{robot.device}/stop", {"reason": "smoke"})
    assert (answer.status_code, answer.json()) == (200, {"confirmed": True})
    wait_until(lambda: robot.stops, "the plain Stop")
    assert (robot.stops[0].caller, robot.stops[0].reason) == ("anna", "smoke")
    assert [command.request for command in robot.heard(StopDevice)] == [StopDevice(reason="smoke")]
    assert robot.heard(ResetStop) == []
    assert anna.post(f"/devices/{robot.device}/stop/reset").json() == {"confirmed": True}
    assert len(robot.heard(ResetStop)) == 1


def test_a_reset_begins_a_new_epoch_so_that_nothing_from_before_it_is_obeyed(pair: Pair) -> None:
    anna, robot = pair
    epoch = anna.take(robot.device).json()["epoch"]
    anna.post(f"/devices/{robot.device}/stop")
    anna.post(f"/devices/{robot.device}/stop/reset")
    assert robot.heard(ResetStop)[0].epoch == epoch + 1
    problem(anna.take(robot.device, epoch=epoch), 409, "lease-lost")
    problem(anna.start(robot.device, epoch=epoch), 409, "lease-lost")
    anna.post(f"/devices/{robot.device}/stop/reset")
    assert robot.heard(ResetStop)[1].epoch == epoch + 2, "each reset can be told from every other"
    assert anna.take(robot.device).json()["epoch"] == epoch + 3


def test_it_needs_no_lease_and_no_body(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    anna.take(robot.device)
    elsewhere = cloud.sign_in("anna")
    assert elsewhere.post(f"/devices/{robot.device}/stop").json() == {"confirmed": True}
    assert elsewhere.post(f"/devices/{robot.device}/stop/reset").json() == {"confirmed": True}


def test_until_it_is_confirmed_the_plain_message_is_repeated(pair: Pair) -> None:
    anna, robot = pair
    robot.silent = True
    assert anna.post(f"/devices/{robot.device}/stop").json() == {"confirmed": False}
    assert len(robot.stops) >= 3
    assert len({stop.id for stop in robot.stops}) == 1
    assert anna.post(f"/devices/{robot.device}/stop/reset").json() == {"confirmed": False}


def test_a_robot_that_is_offline_can_still_be_told(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    robot.say_presence(online=False)
    wait_until(lambda: not anna.get(f"/devices/{robot.device}").json()["online"], "offline")
    assert anna.post(f"/devices/{robot.device}/stop").json() == {"confirmed": True}
    problem(cloud.sign_in("bert").post(f"/devices/{robot.device}/stop"), 404, "device-unknown")


def test_a_reason_has_at_most_2000_characters(pair: Pair) -> None:
    anna, robot = pair
    problem(anna.post(f"/devices/{robot.device}/stop", {"reason": "x" * 2001}), 422, "invalid")
    assert robot.stops == []
    assert anna.post(f"/devices/{robot.device}/stop", {"reason": "🛑" * 2000}).json() == {"confirmed": True}


@pytest.fixture
def two_rooms(cloud: Cloud) -> Iterator[tuple[Person, Robot, Robot, str]]:
    """Anna with two arms in her first space, and one in the lab."""
    with paired(cloud, "anna", "left", "right") as (anna, here), cloud.robot() as there:
        lab = anna.post("/spaces", {"name": "Lab"}).json()["id"]
        there.pair(anna)
        assert anna.put(f"/agents/{there.id}/space", {"space": lab}).status_code == 200
        there.space = lab
        there.connect()
        yield anna, here, there, lab


def stopped(answer: Any) -> dict[str, bool]:
    return {item["device"]: item["confirmed"] for item in answer.json()["items"]}


def test_everything_in_a_space_is_stopped_and_nothing_elsewhere(two_rooms: tuple[Person, Robot, Robot, str]) -> None:
    anna, here, there, lab = two_rooms
    answer = anna.post(f"/spaces/{here.space}/stop", {"reason": "smoke"})
    assert (answer.status_code, stopped(answer)) == (200, dict.fromkeys(here.devices, True))
    assert sorted(command.device for command in here.heard(StopDevice)) == ["left", "right"]
    assert {stop.reason for stop in here.stops} == {"smoke"}
    assert not there.heard(StopDevice)
    assert not there.stops
    assert stopped(anna.post(f"/spaces/{lab}/stop")) == {there.device: True}
    problem(anna.post("/spaces/nowhere/stop"), 404, "space-unknown")


def test_everything_that_one_may_operate_is_stopped_and_what_is_anothers_is_not(
    cloud: Cloud, two_rooms: tuple[Person, Robot, Robot, str]
) -> None:
    anna, here, there, _ = two_rooms
    with paired(cloud, "bert") as (bert, other):
        answer = anna.post("/stop")
        assert (answer.status_code, stopped(answer)) == (200, dict.fromkeys([*here.devices, there.device], True))
        assert not other.commands
        assert not other.stops
        assert stopped(bert.post("/stop")) == {other.device: True}
    assert cloud.sign_in("clara").post("/stop").json() == {"items": []}


def test_one_that_is_dead_keeps_no_other_waiting_and_is_named(two_rooms: tuple[Person, Robot, Robot, str]) -> None:
    anna, here, there, _ = two_rooms
    waiting = [anna.start(here.device, policy="queue", wait_ms=0).json()["id"] for _ in range(3)]
    there.silent = True
    asking = anna.begin("POST", "/stop")
    wait_until(lambda: len(here.heard(StopDevice)) == 2, "the others' Stop")
    answer = asking()
    assert answer.status_code == 207
    assert stopped(answer) == {here.devices[0]: True, here.devices[1]: True, there.device: False}
    assert len(there.stops) >= 3, "repeated until its time is over"
    assert [anna.action(action)["status"] for action in waiting[1:]] == ["cancelled"] * 2
    events = anna.get(f"/devices/{there.device}/events").json()["items"]
    assert [item["kind"] for item in events if item["kind"].startswith("stop")] == ["stop-ordered"]


def test_without_a_broker_each_says_so(broker: MemoryBroker, pair: Pair) -> None:
    anna, robot = pair
    broker.reachable = False
    answer = anna.post("/stop")
    assert answer.status_code == 207
    (item,) = answer.json()["items"]
    assert (item["device"], item["status"], item["confirmed"]) == (robot.device, 503, False)
    assert item["problem"]["type"] == "/problems/broker-unavailable"


def test_stop_and_its_reset_are_told_with_who_did_it(pair: Pair) -> None:
    anna, robot = pair
    anna.take(robot.device)
    anna.post(f"/devices/{robot.device}/stop", {"reason": "smoke"})
    anna.post(f"/devices/{robot.device}/stop/reset")
    events = anna.get(f"/devices/{robot.device}/events").json()["items"]
    reset, stop, _ = events
    assert (reset["kind"], reset["data"]["caller"], reset["data"]["from"]) == ("stop-reset-ordered", "anna", "anna")
    assert (stop["kind"], stop["data"]) == ("stop-ordered", {"caller": "anna", "reason": "smoke"})
    assert stop["severity"] == "warning"
