"""Goal tolerance: measured joints must arrive."""

import math
from collections.abc import Callable, Sequence

import pytest

from device_agent.protocol import Mode
from device_agent.runtime.control.goal_tolerance import SETTLE_TIMEOUT_S, TOLERANCE_RAD
from device_agent.runtime.control.goals import GoalResult, MotionGoal
from device_agent.runtime.planning.trajectory import blend_corners, time_parameterize
from tests.fakes.drivers import PERIOD_S, robot_type
from tests.harness.agent.controller_fixture import ControllerFixture

Servo = Callable[[Sequence[float]], Sequence[float]]


class ServoFixture(ControllerFixture):
    """A fixture with measured joints, computed from the commands by a servo model."""

    def __init__(self, servo: Servo) -> None:
        super().__init__()
        self.servo = servo

    def finish(self, goal: MotionGoal) -> float:
        """Run to the end of a goal; returns how long the command had rested by then [s]."""
        rested_s, until_s = 0.0, self.now_s + 10.0
        while not goal.finished.is_set():
            assert self.now_s < until_s, "it never ends"
            self.now_s += PERIOD_S
            self.controller.update(self.now_s, self.servo(self.controller.commanded_rad))
            rested_s = 0.0 if self.controller.moving else rested_s + PERIOD_S
        return rested_s

    def failure(self, goal: MotionGoal) -> str:
        """Run to the end of a goal, which must fail."""
        self.finish(goal)
        assert goal.result is GoalResult.INTERRUPTED
        assert goal.why is not None
        assert goal.why.code == "not_arrived"
        return goal.why.message


def delayed(periods: int) -> Servo:
    """A servo that follows this many periods later."""
    commands: list[Sequence[float]] = []

    def follow(commanded_rad: Sequence[float]) -> Sequence[float]:
        commands.append(commanded_rad)
        return commands[max(0, len(commands) - 1 - periods)]

    return follow


@pytest.mark.parametrize("periods", [0, 30])
def test_a_goal_ends_when_the_measured_joints_arrive(periods: int) -> None:
    fixture = ServoFixture(delayed(periods))
    move = fixture.move(elbow=1.0)
    rested_s = fixture.finish(move)
    assert move.result is GoalResult.REACHED
    assert fixture.servo(fixture.controller.commanded_rad)[1] == pytest.approx(1.0, abs=TOLERANCE_RAD)
    assert rested_s >= 0.04 or periods == 0
    assert rested_s < 0.4


def test_a_goal_waits_until_the_device_reports_the_end() -> None:
    fixture = ServoFixture(delayed(0))
    move = fixture.move(elbow=1.0)
    for _ in range(500):
        fixture.now_s += PERIOD_S
        fixture.controller.update(fixture.now_s, fixture.servo(fixture.controller.commanded_rad), settled=False)
    assert fixture.controller.commanded_rad[1] == pytest.approx(1.0)
    assert not move.finished.is_set()
    fixture.finish(move)
    assert move.result is GoalResult.REACHED


def test_passing_through_is_not_arrival() -> None:
    swing = iter(range(10_000))
    fixture = ServoFixture(lambda at_rad: (at_rad[0], at_rad[1] + 0.2 * math.cos(next(swing) * PERIOD_S * 20)))
    fixture.failure(fixture.move(elbow=1.0))


@pytest.mark.parametrize("off_rad", [0.12, -0.12, math.nan])
def test_a_joint_that_never_arrives_fails_the_goal(off_rad: float) -> None:
    fixture = ServoFixture(lambda at_rad: (at_rad[0] - 0.2, at_rad[1] - off_rad))
    move = fixture.move(elbow=1.0)
    assert fixture.finish(move) == pytest.approx(SETTLE_TIMEOUT_S, abs=0.1)
    message = fixture.failure(move)
    assert f"elbow is {abs(off_rad):.2f} rad short" in message
    assert "shoulder" not in message, "it was not to move"
    assert fixture.controller.mode is Mode.ACTION
    assert fixture.controller.commanded_rad[1] == pytest.approx(1.0, abs=1e-4)
    fixture.servo = delayed(0)
    again = fixture.move(elbow=0.9)
    fixture.finish(again)
    assert again.result is GoalResult.REACHED


def test_a_soft_joint_is_not_checked() -> None:
    fixture = ServoFixture(lambda at_rad: (at_rad[0], at_rad[1] - 0.3))
    fixture.controller.set_stiffness({"elbow": 0.4}, reservation=fixture.reservation)
    move = fixture.move(elbow=1.0)
    fixture.finish(move)
    assert move.result is GoalResult.REACHED


def test_the_end_of_a_trajectory_is_checked() -> None:
    fixture = ServoFixture(lambda at_rad: (at_rad[0], at_rad[1] - 0.12))
    points = blend_corners([[0.0, 0.0], [0.0, 1.0]], lambda _: True)
    assert points is not None
    trajectory = time_parameterize(points, robot_type().joints, speed=1.0, step_s=PERIOD_S)
    goal = fixture.controller.start_trajectory(fixture.reservation, trajectory)
    assert "elbow is 0.12 rad short" in fixture.failure(goal)
