"""What the room allows: interlocks slow the device and hold it, and nothing resumes by itself."""

import math

import pytest

from device_agent.protocol import Mode
from device_agent.runtime.authority.speed_restrictions import Restriction, Restrictions
from device_agent.runtime.control.goals import GoalResult
from device_agent.runtime.errors import Refused
from tests.harness.agent.controller_fixture import Rig, lost


def test_the_strictest_of_several_sources_counts_until_it_is_lifted() -> None:
    restrictions = Restrictions()
    assert (restrictions.speed, restrictions.strictest, restrictions.all) == (1.0, None, ())
    restrictions.set("door", 0.5, "the door is open")
    restrictions.set("zone", 0.2, "somebody is near")
    assert restrictions.speed == 0.2
    assert restrictions.strictest == Restriction("zone", 0.2, "somebody is near")
    restrictions.clear("zone")
    restrictions.clear("never set")
    assert restrictions.speed == 0.5


@pytest.mark.parametrize("speed", [math.nan, math.inf, -0.1, 1.1])
def test_a_speed_that_is_no_share_means_hold(speed: float) -> None:
    restrictions = Restrictions()
    restrictions.set("zone", speed, "?")
    assert restrictions.speed == 0.0


def test_a_slowed_stream_is_slower_says_why_and_speeds_up_again_by_itself() -> None:
    rig = Rig()
    rig.take(1)
    rig.controller.restrict("zone", 0.25, "somebody is near")
    assert rig.controller.restrictions == (Restriction("zone", 0.25, "somebody is near"),)
    rig.stream(1, 1.5)
    assert 0.2 < max(rig.velocities) <= 0.25 * 0.35 * 3.0 + 1e-6
    assert rig.limited == {"interlock: somebody is near"}
    rig.controller.lift("zone")
    rig.stream(1, 0.6)
    assert max(rig.velocities) > 0.9


def test_a_move_in_mid_motion_is_slowed_and_goes_on_when_the_zone_is_free() -> None:
    rig = Rig()
    tenure = rig.controller.reserve(epoch=1, on_revoked=lost)
    move = rig.controller.start_joint_goal(tenure, {"elbow": 2.5}, speed=1.0)
    rig.run(0.5)
    rig.controller.restrict("zone", 0.1, "somebody is near")
    rig.run(1.0)
    assert abs(rig.velocities[-1]) <= 0.1 * 3.0 + 1e-6
    assert not move.finished.is_set()
    rig.controller.lift("zone")
    rig.run(2.0)
    assert move.result is GoalResult.REACHED
    assert move.limited == ("interlock: somebody is near",)


def test_a_hold_stops_a_stream_and_lifting_it_resumes_nothing() -> None:
    rig = Rig()
    rig.take(1)
    rig.stream(1, 1.0)
    rig.controller.restrict("zone", 0.0, "somebody is there")
    assert rig.at_rest_after(0.5) < 0.2
    assert rig.controller.mode is Mode.HOLDING
    rig.controller.lift("zone")
    rest = rig.elbow
    with pytest.raises(Refused) as refused:
        rig.offer(1)
    assert refused.value.code == "no_lease"
    rig.run(1.0)
    assert rig.elbow == pytest.approx(rest, abs=1e-9)
    rig.take(2)
    rig.stream(2, 0.3)
    assert rig.elbow > rest


def test_a_hold_ends_an_action_and_refuses_the_next() -> None:
    rig = Rig()
    why: list[Refused] = []
    tenure = rig.controller.reserve(epoch=1, on_revoked=why.append)
    move = rig.controller.start_joint_goal(tenure, {"elbow": 2.5}, speed=0.5)
    rig.run(0.5)
    rig.controller.restrict("zone", 0.0, "somebody is there")
    rig.run(0.3)
    assert (move.result, [refused.code for refused in why]) == (GoalResult.INTERRUPTED, ["interlock"])
    assert not rig.controller.moving
    with pytest.raises(Refused) as refused:
        rig.controller.reserve(epoch=2, on_revoked=lost)
    assert refused.value.code == "interlock"
    assert "somebody is there" in refused.value.message


def test_an_operator_at_rest_keeps_control_through_a_hold_unless_they_push_against_it() -> None:
    rig = Rig()
    rig.take(1)
    rig.controller.restrict("zone", 0.0, "somebody is there")
    assert rig.run(0.1) is Mode.HOLDING
    rig.controller.lift("zone")
    assert rig.run(0.1) is Mode.IDLE
    rig.stream(1, 0.1)
    rig.stream(1, 2.0, elbow=0.0)
    rig.run(0.5)
    rig.controller.restrict("zone", 0.0, "somebody is there")
    with pytest.raises(Refused) as refused:
        rig.offer(1)
    assert refused.value.code == "interlock"
    rig.controller.lift("zone")
    with pytest.raises(Refused) as refused:
        rig.offer(1)
    assert refused.value.code == "no_lease", "the arm must not start because a person leaves"


def test_a_setpoint_that_waits_for_its_first_period_is_held_too() -> None:
    rig = Rig()
    rig.take(1)
    rig.offer(1)
    rig.controller.restrict("zone", 0.0, "somebody is there")
    rig.controller.lift("zone")
    rig.run(0.3)
    assert rig.elbow == 0.0
