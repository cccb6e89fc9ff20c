"""Driving: duration, limits and braking."""

import math
from itertools import pairwise

import pytest

from device_agent.ports.driver import REST, Twist
from device_agent.runtime.control.base_motion import BaseMotion
from device_agent.runtime.control.goals import DriveGoal, GoalResult
from device_agent.runtime.control.joint_motion import MotionError
from tests.fakes.drivers import BASE, PERIOD_S
from tests.harness.agent.controller_fixture import ControllerFixture, interruptions, refuses

AT_REST = pytest.approx(REST, abs=1e-6)


class BaseFixture(ControllerFixture):
    def __init__(self) -> None:
        super().__init__(base=BASE)
        self.grant(1, lease_s=5.0)

    def twists(self, seconds: float) -> list[Twist]:
        self.outputs.clear()
        self.run(seconds)
        return [output.twist for output in self.outputs]

    def drive(self, twist: Twist = Twist(0.4, 0.0, -0.5), duration_s: float = 2.0) -> DriveGoal:  # noqa: B008 (a tuple)
        return self.controller.start_drive(self.reservation, twist, duration_s=duration_s)


def test_a_drive_accelerates_keeps_its_twist_and_ends() -> None:
    fixture = BaseFixture()
    drive = fixture.drive()
    twists = fixture.twists(2.0)
    assert not drive.finished.is_set()
    assert twists[-1] == pytest.approx(Twist(0.4, 0.0, -0.5))
    gains = [(b.forward_m_s - a.forward_m_s) / PERIOD_S for a, b in pairwise(twists)]
    assert max(gains) <= BASE.max_linear_acceleration_m_s2 + 1e-6
    assert fixture.twists(0.3)[-1] == AT_REST
    assert drive.result is GoalResult.REACHED
    assert fixture.elbow == 0.0


@pytest.mark.parametrize("cause", [*interruptions(), "end of the action"])
def test_every_revocation_brakes_the_base(cause: str) -> None:
    fixture = BaseFixture()
    drive = fixture.drive(duration_s=50.0)
    fixture.twists(1.0)
    assert fixture.controller.moving
    if cause in interruptions():
        interruptions()[cause](fixture)
    else:
        fixture.controller.end_reservation(fixture.reservation)
        fixture.controller.end_reservation(fixture.reservation)
    assert fixture.twists(0.3)[-1] == AT_REST
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
    fixture = BaseFixture()
    drive = fixture.drive()
    fixture.twists(1.0)
    fixture.controller.restrict("zone", 0.5, "a person is near")
    assert fixture.twists(0.8)[-1] == pytest.approx(Twist(0.2, 0.0, -0.25))
    assert drive.limited == ("interlock: a person is near",)


def test_drive_and_joint_goals_replace_each_other() -> None:
    fixture = BaseFixture()
    move = fixture.move(elbow=2.0)
    fixture.run(0.3)
    drive = fixture.drive(duration_s=5.0)
    fixture.run(0.5)
    assert (move.result, move.why and move.why.code) == (GoalResult.INTERRUPTED, "replaced")
    fixture.move(elbow=0.0)
    fixture.run(2.0)
    assert drive.result is GoalResult.INTERRUPTED
    assert not fixture.controller.moving


@pytest.mark.parametrize(
    ("twist", "duration_s", "code"),
    [
        (Twist(0.6), 1.0, "out_of_range"),
        (Twist(0.0, 0.1), 1.0, "out_of_range"),
        (Twist(math.nan), 1.0, "out_of_range"),
        (Twist(0.1), 0.0, "bad_duration"),
        (Twist(0.1), 61.0, "bad_duration"),
        (Twist(0.1), math.nan, "bad_duration"),
    ],
)
def test_invalid_drives_are_rejected(twist: Twist, duration_s: float, code: str) -> None:
    fixture = BaseFixture()
    with refuses(code):
        fixture.drive(twist, duration_s)
    assert fixture.twists(0.1)[-1] == REST


def test_a_robot_without_a_base_does_not_drive() -> None:
    fixture = ControllerFixture()
    with refuses("no_base"):
        fixture.controller.start_drive(fixture.reservation, Twist(0.1), duration_s=1.0)


def test_after_a_fault_the_base_is_at_rest() -> None:
    fixture = BaseFixture()
    fixture.drive()
    fixture.twists(0.5)
    fixture.controller.set_fault("no answer")
    fixture.controller.clear_fault([0.0, 0.0])
    assert fixture.twists(0.1)[0] == REST


def test_an_impossible_base_motion_is_an_error() -> None:
    motion = BaseMotion(BASE, PERIOD_S)
    motion.follow(Twist(math.nan))
    with pytest.raises(MotionError):
        motion.update()


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
