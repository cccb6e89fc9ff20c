"""Stop and its reset: two ways out, no lease asked for."""

import pytest

from device_agent.protocol.messages import ResetStop, StopDevice
from tests.support.brokers import BROKERS, wait_until
from tests.support.cloud import Cloud, Person, Robot, problem

Pair = tuple[Person, Robot]


@pytest.mark.parametrize("broker", BROKERS, indirect=True)
def test_stop_goes_out_plain_and_signed_and_reset_signed(pair: Pair) -> None:
    anna, robot = pair
    answer = anna.post(f"/devices/{robot.device}/stop", {"reason": "smoke"})
    assert (answer.status_code, answer.json()) == (200, {"confirmed": True})
    wait_until(lambda: robot.stops, "the plain Stop")
    assert (robot.stops[0].by, robot.stops[0].reason) == ("anna", "smoke")
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
