"""Goal tolerance: measured joints must arrive."""

import math
from collections.abc import Callable, Sequence

import pytest

from device_agent.protocol import Mode
from device_agent.runtime.control.goal_tolerance import SETTLE_TIMEOUT_S, TOLERANCE_RAD
from device_agent.runtime.control.goals import GoalResult, MotionGoal
from device_agent.runtime.planning.motion_planner import MotionPlanner
from tests.fakes.drivers import PERIOD_S, robot_type
from tests.harness.agent.controller_fixture import ControllerFixture, Wall, ignore_revocation

Servo = Callable[[Sequence[float]], Sequence[float]]


class Loaded(ControllerFixture):
    """A fixture with measured joints, computed from the commands by a servo model."""

    def __init__(self, servo: Servo) -> None:
        super().__init__()
        self.servo = servo
        self.reservation = self.controller.reserve(epoch=1, on_revoked=ignore_revocation)

    def go(self, course: MotionGoal, *, most_s: float = 10.0) -> float:
        """Until its end; gives how long the command had rested by then [s]."""
        rested_s, until_s = 0.0, self.now_s + most_s
        while not course.finished.is_set():
            assert self.now_s < until_s, "it never ends"
            self.now_s += PERIOD_S
            measured = self.servo(self.controller.commanded_rad)
            self.controller.update(self.now_s, measured)
            rested_s = 0.0 if self.controller.moving else rested_s + PERIOD_S
        return rested_s

    def move(self, **position_rad: float) -> MotionGoal:
        return self.controller.start_joint_goal(self.reservation, position_rad, speed=1.0)


def late(periods: int) -> Servo:
    """A servo that follows so much later."""
    told: list[Sequence[float]] = []

    def follow(commanded_rad: Sequence[float]) -> Sequence[float]:
        told.append(commanded_rad)
        return told[max(0, len(told) - 1 - periods)]

    return follow


@pytest.mark.parametrize("periods", [0, 30])
def test_a_goal_ends_when_the_measured_joints_arrive(periods: int) -> None:
    fixture = Loaded(late(periods))
    move = fixture.move(elbow=1.0)
    rested_s = fixture.go(move)
    assert move.result is GoalResult.REACHED
    assert fixture.servo(fixture.controller.commanded_rad)[1] == pytest.approx(1.0, abs=TOLERANCE_RAD)
    assert rested_s >= 0.04 or periods == 0
    assert rested_s < 0.4


def test_passing_through_is_not_arrival() -> None:
    swing = iter(range(10_000))
    fixture = Loaded(lambda told: (told[0], told[1] + 0.2 * math.cos(next(swing) * PERIOD_S * 20)))
    move = fixture.move(elbow=1.0)
    fixture.go(move)
    assert move.why is not None
    assert move.why.code == "not_arrived"


@pytest.mark.parametrize("off_rad", [0.12, -0.12, math.nan])
def test_a_joint_that_never_arrives_fails_the_goal(off_rad: float) -> None:
    fixture = Loaded(lambda told: (told[0] - 0.2, told[1] - off_rad))
    move = fixture.move(elbow=1.0)
    rested_s = fixture.go(move)
    assert move.result is GoalResult.INTERRUPTED
    assert move.why is not None
    assert move.why.code == "not_arrived"
    assert f"elbow is {abs(off_rad):.2f} rad short" in move.why.message
    assert "shoulder" not in move.why.message, "it was not to move"
    assert rested_s == pytest.approx(SETTLE_TIMEOUT_S, abs=0.1)
    assert fixture.controller.mode is Mode.ACTION
    assert fixture.controller.commanded_rad[1] == pytest.approx(1.0, abs=1e-4)
    again = fixture.move(elbow=0.9)
    fixture.servo = late(0)
    fixture.go(again)
    assert again.result is GoalResult.REACHED


def test_a_soft_joint_is_not_checked() -> None:
    fixture = Loaded(lambda told: (told[0], told[1] - 0.3))
    fixture.controller.set_stiffness({"elbow": 0.4}, reservation=fixture.reservation)
    move = fixture.move(elbow=1.0)
    fixture.go(move)
    assert move.result is GoalResult.REACHED


def test_the_end_of_a_trajectory_is_checked() -> None:
    class Open(Wall):
        def plan(
            self, start_rad: Sequence[float], goal_rad: Sequence[float], **_: object
        ) -> tuple[tuple[float, ...], ...]:
            return tuple(start_rad), tuple(goal_rad)

    fixture = Loaded(lambda told: (told[0], told[1] - 0.12))
    way = MotionPlanner(robot_type(), Open(9.0)).plan([0.0, 0.0], [0.0, 1.0], speed=1.0, ended=lambda: False)
    goal = fixture.controller.start_trajectory(fixture.reservation, way)
    fixture.go(goal)
    assert goal.why is not None
    assert "elbow is 0.12 rad short" in goal.why.message
