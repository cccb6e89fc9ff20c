"""Driving: duration, limits and braking."""

import math
from itertools import pairwise

import pytest

from device_agent.ports.driver import REST, Twist
from device_agent.runtime.control.base_motion import BaseMotion
from device_agent.runtime.control.goals import DriveGoal, GoalResult
from device_agent.runtime.control.joint_motion import MotionError
from device_agent.runtime.errors import Refused
from tests.fakes.drivers import BASE, PERIOD_S
from tests.harness.agent.controller_fixture import ControllerFixture, interruptions, refuses


def twists(fixture: ControllerFixture, seconds: float) -> list[Twist]:
    found = []
    for _ in range(round(seconds / PERIOD_S)):
        fixture.now_s += PERIOD_S
        found.append(fixture.controller.update(fixture.now_s).twist)
    return found


def driving(fixture: ControllerFixture, duration_s: float = 2.0) -> DriveGoal:
    reservation = fixture.reserve()
    return fixture.controller.start_drive(reservation, Twist(0.4, 0.0, -0.5), duration_s=duration_s)


def test_a_drive_accelerates_keeps_its_twist_and_ends() -> None:
    fixture = ControllerFixture(base=BASE)
    drive = driving(fixture)
    found = twists(fixture, 2.0)
    assert not drive.finished.is_set()
    assert found[-1] == pytest.approx(Twist(0.4, 0.0, -0.5))
    gains = [(b.forward_m_s - a.forward_m_s) / PERIOD_S for a, b in pairwise(found)]
    assert max(gains) <= BASE.max_linear_acceleration_m_s2 + 1e-6
    assert twists(fixture, 0.3)[-1] == pytest.approx(REST, abs=1e-6)
    assert drive.result is GoalResult.REACHED
    assert fixture.elbow == 0.0


@pytest.mark.parametrize("cause", interruptions())
def test_every_revocation_brakes_the_base(cause: str) -> None:
    fixture = ControllerFixture(base=BASE)
    fixture.take(1, lease_s=5.0)
    drive = driving(fixture, duration_s=50.0)
    twists(fixture, 1.0)
    assert fixture.controller.moving
    interruptions()[cause](fixture)  # type: ignore[operator]
    assert twists(fixture, 0.3)[-1] == pytest.approx(REST, abs=1e-6)
    assert drive.result is GoalResult.INTERRUPTED
    assert not fixture.controller.moving


def test_a_new_twist_while_braking_does_not_reverse_the_base() -> None:
    motion = BaseMotion(BASE, PERIOD_S)
    motion.follow(Twist(-0.2))
    for _ in range(100):
        motion.update()
    motion.brake()
    for _ in range(2):
        motion.update()
    for _ in range(200):
        motion.follow(Twist(-0.2))
        assert motion.update().forward_m_s <= 1e-6
    assert motion.twist == pytest.approx(Twist(-0.2))


def test_a_restriction_slows_a_drive() -> None:
    fixture = ControllerFixture(base=BASE)
    drive = driving(fixture)
    twists(fixture, 1.0)
    fixture.controller.restrict("zone", 0.5, "a person is near")
    assert twists(fixture, 0.8)[-1] == pytest.approx(Twist(0.2, 0.0, -0.25))
    assert drive.limited == ("interlock: a person is near",)


def test_drive_and_joint_goals_replace_each_other() -> None:
    fixture = ControllerFixture(base=BASE)
    reservation = fixture.reserve()
    move = fixture.controller.start_joint_goal(reservation, {"elbow": 2.0}, speed=1.0)
    fixture.run(0.3)
    drive = fixture.controller.start_drive(reservation, Twist(0.4), duration_s=5.0)
    fixture.run(0.5)
    assert (move.result, move.why and move.why.code) == (GoalResult.INTERRUPTED, "replaced")
    fixture.controller.start_joint_goal(reservation, {"elbow": 0.0}, speed=1.0)
    fixture.run(2.0)
    assert drive.result is GoalResult.INTERRUPTED
    assert not fixture.controller.moving


def refusals() -> dict[str, tuple[Twist, float]]:
    return {
        "out_of_range": (Twist(0.6), 1.0),
        "out_of_range sideways": (Twist(0.0, 0.1), 1.0),
        "out_of_range nan": (Twist(math.nan), 1.0),
        "bad_duration": (Twist(0.1), 0.0),
        "bad_duration long": (Twist(0.1), 61.0),
        "bad_duration nan": (Twist(0.1), math.nan),
    }


@pytest.mark.parametrize("case", refusals())
def test_invalid_drives_are_rejected(case: str) -> None:
    fixture = ControllerFixture(base=BASE)
    reservation = fixture.reserve()
    twist, duration_s = refusals()[case]
    with pytest.raises(Refused) as refused:
        fixture.controller.start_drive(reservation, twist, duration_s=duration_s)
    assert refused.value.code == case.split(maxsplit=1)[0]
    assert twists(fixture, 0.1)[-1] == REST


def test_a_robot_without_a_base_does_not_drive() -> None:
    fixture = ControllerFixture()
    reservation = fixture.reserve()
    with refuses("no_base"):
        fixture.controller.start_drive(reservation, Twist(0.1), duration_s=1.0)


def test_after_a_fault_the_base_is_at_rest() -> None:
    fixture = ControllerFixture(base=BASE)
    driving(fixture)
    twists(fixture, 0.5)
    fixture.controller.set_fault("no answer")
    fixture.controller.clear_fault([0.0, 0.0])
    assert twists(fixture, 0.1)[0] == REST


def test_an_impossible_base_motion_is_an_error() -> None:
    motion = BaseMotion(BASE, PERIOD_S)
    motion.follow(Twist(math.nan))
    with pytest.raises(MotionError):
        motion.update()


def test_the_end_of_an_action_brakes_its_drive() -> None:
    fixture = ControllerFixture(base=BASE)
    reservation = fixture.reserve()
    drive = fixture.controller.start_drive(reservation, Twist(0.4), duration_s=5.0)
    twists(fixture, 0.5)
    fixture.controller.end_reservation(reservation)
    fixture.controller.end_reservation(reservation)
    assert twists(fixture, 0.3)[-1] == pytest.approx(REST, abs=1e-6)
    assert drive.result is GoalResult.INTERRUPTED


def test_two_parts_of_a_period_brake_a_base_as_much_as_a_whole_one() -> None:
    ends = []
    for parts in ((None,), (PERIOD_S / 4, 3 * PERIOD_S / 4)):
        motion = BaseMotion(BASE, PERIOD_S)
        for _ in range(100):
            motion.follow(Twist(0.3, 0.0, 0.0))
            motion.update()
        motion.brake()
        for part in parts:
            motion.update(part)
        ends.append(tuple(motion.twist))
    assert ends[0] == pytest.approx(ends[1])
    assert 0 < ends[0][0] < 0.3
