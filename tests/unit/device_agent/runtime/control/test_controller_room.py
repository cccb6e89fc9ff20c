"""Interlocks in the controller: slow, hold, and no automatic resumption."""

import math

import pytest

from device_agent.protocol import Mode
from device_agent.runtime.authority.speed_restrictions import Restriction, Restrictions
from device_agent.runtime.control.goals import GoalResult
from device_agent.runtime.errors import Refused
from tests.harness.agent.controller_fixture import ControllerFixture, ignore_revocation, leased, refuses


def test_the_strictest_restriction_applies_until_it_is_lifted() -> None:
    restrictions = Restrictions()
    assert (restrictions.speed, restrictions.strictest, restrictions.all) == (1.0, None, ())
    restrictions.set("door", 0.5, "the door is open")
    restrictions.set("zone", 0.2, "a person is near")
    assert restrictions.speed == 0.2
    assert restrictions.strictest == Restriction("zone", 0.2, "a person is near")
    restrictions.clear("zone")
    restrictions.clear("never set")
    assert restrictions.speed == 0.5


@pytest.mark.parametrize("speed", [math.nan, math.inf, -0.1, 1.1])
def test_an_invalid_speed_means_hold(speed: float) -> None:
    restrictions = Restrictions()
    restrictions.set("zone", speed, "?")
    assert restrictions.speed == 0.0


def test_a_restriction_slows_a_stream_and_is_reported() -> None:
    fixture = leased()
    fixture.controller.restrict("zone", 0.25, "a person is near")
    assert fixture.controller.restrictions == (Restriction("zone", 0.25, "a person is near"),)
    fixture.stream(1, 1.5)
    assert 0.2 < max(fixture.velocities) <= 0.25 * 0.35 * 3.0 + 1e-6
    assert fixture.limited == {"interlock: a person is near"}
    fixture.controller.lift("zone")
    fixture.stream(1, 0.6)
    assert max(fixture.velocities) > 0.9


def test_a_restriction_slows_a_goal_until_it_is_lifted() -> None:
    fixture = ControllerFixture()
    reservation = fixture.reserve()
    move = fixture.controller.start_joint_goal(reservation, {"elbow": 2.5}, speed=1.0)
    fixture.run(0.5)
    fixture.controller.restrict("zone", 0.1, "a person is near")
    fixture.run(1.0)
    assert abs(fixture.velocities[-1]) <= 0.1 * 3.0 + 1e-6
    assert not move.finished.is_set()
    fixture.controller.lift("zone")
    fixture.run(2.0)
    assert move.result is GoalResult.REACHED
    assert move.limited == ("interlock: a person is near",)


def test_a_hold_stops_a_stream_and_lifting_it_resumes_nothing() -> None:
    fixture = leased()
    fixture.stream(1, 1.0)
    fixture.controller.restrict("zone", 0.0, "a person is there")
    assert fixture.at_rest_after(0.5) < 0.2
    assert fixture.controller.mode is Mode.HOLDING
    fixture.controller.lift("zone")
    rest = fixture.elbow
    with refuses("no_lease"):
        fixture.offer(1)
    fixture.run(1.0)
    assert fixture.elbow == pytest.approx(rest, abs=1e-9)
    fixture.take(2)
    fixture.stream(2, 0.3)
    assert fixture.elbow > rest


def test_a_hold_ends_an_action_and_rejects_the_next() -> None:
    fixture = ControllerFixture()
    why: list[Refused] = []
    reservation = fixture.controller.reserve(epoch=1, on_revoked=why.append)
    move = fixture.controller.start_joint_goal(reservation, {"elbow": 2.5}, speed=0.5)
    fixture.run(0.5)
    fixture.controller.restrict("zone", 0.0, "a person is there")
    fixture.run(0.3)
    assert (move.result, [refused.code for refused in why]) == (GoalResult.INTERRUPTED, ["interlock"])
    assert not fixture.controller.moving
    with pytest.raises(Refused) as refused:
        fixture.controller.reserve(epoch=2, on_revoked=ignore_revocation)
    assert refused.value.code == "interlock"
    assert "a person is there" in refused.value.message


def test_a_hold_at_rest_keeps_the_lease_until_a_setpoint_arrives() -> None:
    fixture = leased()
    fixture.controller.restrict("zone", 0.0, "a person is there")
    assert fixture.run(0.1) is Mode.HOLDING
    fixture.controller.lift("zone")
    assert fixture.run(0.1) is Mode.IDLE
    fixture.stream(1, 0.1)
    fixture.stream(1, 2.0, elbow=0.0)
    fixture.run(0.5)
    fixture.controller.restrict("zone", 0.0, "a person is there")
    with refuses("interlock"):
        fixture.offer(1)
    fixture.controller.lift("zone")
    with refuses("no_lease"):
        fixture.offer(1)


def test_a_hold_discards_a_waiting_setpoint() -> None:
    fixture = leased()
    fixture.offer(1)
    fixture.controller.restrict("zone", 0.0, "a person is there")
    fixture.controller.lift("zone")
    fixture.run(0.3)
    assert fixture.elbow == 0.0
