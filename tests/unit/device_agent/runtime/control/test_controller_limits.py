"""Limits for every source of motion."""

import math
from collections.abc import Sequence

import msgspec
import pytest
from ruckig import InputParameter, Result, Ruckig, RuckigError, Trajectory

from device_agent.ports.geometry import Sweep
from device_agent.protocol import Mode
from device_agent.protocol.manifests.robot_type import Workspace
from device_agent.runtime.control.goals import GoalResult
from device_agent.runtime.control.joint_motion import JointMotion, MotionError, generate
from device_agent.runtime.control.latency_limiter import LatencyLimiter
from device_agent.runtime.control.limits import MotionLimits
from device_agent.runtime.errors import Refused
from tests.fakes.drivers import PERIOD_S, robot_type
from tests.harness.agent.controller_fixture import WALL_RAD, ControllerFixture, Wall, leased, refuses


def test_a_streamed_arm_stops_before_the_wall_and_reports_it() -> None:
    fixture = ControllerFixture(geometry=Wall())
    fixture.take(1)
    assert fixture.stream(1, 4.0) is Mode.STREAMING
    assert WALL_RAD - 0.02 < fixture.elbow <= WALL_RAD + 1e-6
    assert not fixture.controller.moving
    assert "clearance: hand \u2013 wall" in fixture.limited
    fixture.stream(1, 1.0, elbow=0.2)
    assert fixture.elbow == pytest.approx(0.2, abs=1e-3)
    assert fixture.controller.update(fixture.now_s + PERIOD_S).limited == ()


def test_an_operator_who_pushes_against_the_wall_moves_nothing() -> None:
    fixture = ControllerFixture(geometry=Wall())
    fixture.take(1)
    fixture.stream(1, 4.0)
    rest = fixture.elbow
    for push in range(50):
        fixture.stream(1, 0.05, elbow=1.5 + push * 0.01)
    assert fixture.elbow - rest < 0.01
    assert fixture.elbow <= WALL_RAD + 1e-6


def test_a_goal_at_full_speed_stops_before_the_wall() -> None:
    fixture = ControllerFixture(geometry=Wall(2.0))
    reservation = fixture.reserve()
    wall = Wall(2.0)
    fixture.controller._state.limits._geometry = None  # the target is not looked at: only the way is
    move = fixture.controller.start_joint_goal(reservation, {"elbow": 2.9}, speed=1.0)
    fixture.controller._state.limits._geometry = wall
    fixture.run(3.0)
    assert 1.9 < fixture.elbow <= 2.0
    assert move.result is GoalResult.INTERRUPTED
    assert move.why is not None
    assert (move.why.code, "hand \u2013 wall" in move.why.message) == ("no_room", True)
    assert move.limited == ("clearance: hand \u2013 wall",)
    assert fixture.controller.mode is Mode.ACTION
    fixture.controller.start_joint_goal(reservation, {"elbow": 0.0}, speed=1.0)
    fixture.run(2.5)
    assert fixture.elbow == pytest.approx(0.0, abs=1e-4)


def test_a_goal_without_clearance_is_rejected_with_the_obstacle() -> None:
    fixture = ControllerFixture(geometry=Wall())
    reservation = fixture.reserve()
    with pytest.raises(Refused) as refused:
        fixture.controller.start_joint_goal(reservation, {"elbow": 1.25}, speed=1.0)
    assert refused.value.code == "no_room"
    assert "hand \u2013 wall, 250 mm" in refused.value.message
    fixture.run(0.5)
    assert fixture.elbow == 0.0


def test_a_robot_that_is_too_near_may_only_move_away() -> None:
    fixture = ControllerFixture(geometry=Wall())
    fixture.controller.start_at([0.0, 1.3])
    reservation = fixture.reserve()
    with pytest.raises(Refused):
        fixture.controller.start_joint_goal(reservation, {"elbow": 1.4}, speed=1.0)
    assert fixture.controller.start_joint_goal(reservation, {"elbow": 1.2}, speed=1.0)
    fixture.run(1.0)
    fixture.controller.start_joint_goal(reservation, {"elbow": 0.5}, speed=1.0)
    fixture.run(1.0)
    assert fixture.elbow == pytest.approx(0.5, abs=1e-4)


@pytest.mark.parametrize("speed", [0.0, -1.0, 1.1, math.nan, math.inf])
def test_an_invalid_speed_is_rejected(speed: float) -> None:
    fixture = ControllerFixture()
    reservation = fixture.reserve()
    with refuses("bad_speed"):
        fixture.controller.start_joint_goal(reservation, {"elbow": 1.0}, speed=speed)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_position_that_is_not_finite_is_rejected_for_every_source(value: float) -> None:
    fixture = leased()
    with refuses("not_finite"):
        fixture.offer(1, elbow=value)
    reservation = fixture.reserve()
    with refuses("not_finite"):
        fixture.controller.start_joint_goal(reservation, {"elbow": value}, speed=1.0)


def test_speed_before_the_wall_falls_with_loop_age() -> None:
    """v <= clearance / (loop age + watchdog + braking time), all the way."""
    fastest = {}
    for age_ms in (20, 190):
        fixture = ControllerFixture(geometry=Wall(1.5))
        fixture.take(1)
        for _ in range(200):
            fixture.stream(1, 0.024, age_ms=age_ms)
            velocity = fixture.velocities[-1]
            blind_s = age_ms / 1000 + 0.3 + abs(velocity) / 20.0
            assert velocity <= max(0.02, (1.5 - fixture.elbow) / blind_s) + 1e-3
        fastest[age_ms] = fixture.now_s
        assert "speed: loop age" in fixture.limited
        assert fixture.elbow == pytest.approx(1.5, abs=0.02)


def test_a_low_loop_age_with_clearance_allows_full_speed() -> None:
    fixture = ControllerFixture(geometry=Wall(2.9))
    fixture.take(1)
    fixture.stream(1, 1.2, age_ms=40)
    assert max(fixture.velocities) == pytest.approx(0.35 * 3.0, rel=1e-6)
    assert fixture.limited == set()


def test_without_geometry_loop_age_alone_limits_the_speed() -> None:
    fixture = leased()
    fixture.stream(1, 1.0, age_ms=90)
    assert max(fixture.velocities) == pytest.approx(0.35 * 3.0, rel=1e-6)
    assert fixture.limited == set()
    fixture = leased()
    fixture.stream(1, 1.5, age_ms=150)
    assert fixture.velocities[-1] == pytest.approx(0.5 * 0.35 * 3.0, rel=1e-3)
    assert fixture.limited == {"speed: loop age"}
    fixture = leased()
    fixture.stream(1, 1.0, age_ms=200)
    assert 0 < fixture.velocities[-1] <= 0.1 * 0.35 * 3.0 + 1e-6


def test_one_late_setpoint_does_not_limit_the_speed() -> None:
    limiter = LatencyLimiter(None, watchdog_s=0.3, max_age_s=0.2)
    assert limiter.age_s == 0.0
    for _ in range(50):
        limiter.add_age(0.03)
    limiter.add_age(0.19)
    assert limiter.age_s < 0.07
    assert limiter.joint_share() == 1.0
    limiter.reset()
    assert limiter.age_s == 0.0


def test_changes_by_the_driver_are_reported() -> None:
    fixture = ControllerFixture()
    reservation = fixture.reserve()
    move = fixture.controller.start_joint_goal(reservation, {"elbow": 1.0}, speed=1.0)
    fixture.run(0.1)
    fixture.controller.record_applied([0.0, fixture.elbow - 0.01])
    assert fixture.controller.update(fixture.now_s + PERIOD_S).limited == ("elbow: driver",)
    assert move.limited == ("elbow: driver",)
    fixture.controller.record_applied(fixture.controller._state.motion.position_rad)
    assert fixture.controller.update(fixture.now_s + 2 * PERIOD_S).limited == ()


def test_a_geometry_error_in_motion_is_not_permission() -> None:
    """The loop that calls ``step`` takes any error for a fault, and holds."""

    class Broken(Wall):
        def sweep(self, path_rad: Sequence[Sequence[float]]) -> Sweep:  # noqa: ARG002
            raise RuntimeError("no shape")

    fixture = ControllerFixture(geometry=Broken())
    reservation = fixture.reserve()
    fixture.controller.start_joint_goal(reservation, {"elbow": 0.5}, speed=1.0)
    with pytest.raises(RuntimeError):
        fixture.run(0.1)
    fixture.controller.set_fault("internal error")
    fixture.run(0.2)
    assert fixture.elbow == pytest.approx(0.0, abs=1e-4)


def test_a_new_target_while_braking_does_not_reverse_the_arm() -> None:
    fixture = leased()
    fixture.stream(1, 1.5, elbow=2.9)
    fixture.take(2)
    fixture.run(2 * PERIOD_S)
    fixture.velocities.clear()
    fixture.stream(2, 1.0, elbow=2.9)
    assert min(fixture.velocities) > -1e-3
    assert fixture.elbow > 1.0


def test_a_motion_that_cannot_brake_is_an_error() -> None:
    motion = JointMotion(robot_type())
    motion.follow([1.0, 1.0])
    motion._braking = math.nan
    with pytest.raises(MotionError):
        motion.propose()


def test_a_planner_that_finds_nothing_is_an_error() -> None:
    with pytest.raises(MotionError):
        generate(lambda _order, _answer: Result.ErrorExecutionTimeCalculation, None, None)


def test_a_trajectory_hidden_by_rounding_is_found_at_a_lower_speed() -> None:
    order = InputParameter(1)
    # A joint that would meet both limits, and leave them again, at one moment.
    order.current_position, order.target_position = [0.8000000000000002], [0.5]
    order.max_velocity, order.max_acceleration, order.max_jerk = [3.0], [60.0], [1200.0]
    with pytest.raises(RuckigError):
        Ruckig(1).calculate(order, Trajectory(1))
    found = Trajectory(1)
    generate(Ruckig(1).calculate, order, found)
    assert found.at_time(found.duration)[0] == pytest.approx([0.5])
    assert order.max_velocity == [3.0]


def test_a_motion_that_cannot_be_planned_holds_and_ends_the_lease() -> None:
    fixture = leased()
    fixture.stream(1, 0.5)
    fixture.controller._state.motion._jerk_limits = [math.nan, math.nan]
    assert fixture.stream(1, 0.024) is Mode.HOLDING
    assert fixture.controller.moving, "it brakes, and does not stand still with a jerk"
    assert fixture.at_rest_after(0.3) < 0.1
    assert fixture.controller.lease(fixture.now_s) is None


def test_a_motion_that_cannot_brake_stops_at_once() -> None:
    fixture = leased()
    fixture.stream(1, 0.5)
    fixture.controller._state.motion._jerk_limits = [math.nan, math.nan]
    fixture.controller._state.motion._braking = math.nan
    rest = fixture.elbow
    assert fixture.stream(1, 0.024) is Mode.HOLDING
    assert fixture.elbow == rest


def test_limits_are_listed_by_available_model() -> None:
    known = ("position", "velocity", "acceleration", "jerk")
    assert ControllerFixture().controller.limits == known
    assert ControllerFixture(geometry=Wall()).controller.limits == (*known, "clearance")
    box = Workspace(lower_m=(-1, -1, 0), upper_m=(1, 1, 1), frames=("hand",))
    kind = msgspec.structs.replace(robot_type(), workspace=box)
    assert MotionLimits(kind, Wall()).names == (*known, "clearance", "workspace")


def test_a_path_without_motion_is_not_checked() -> None:
    limits = MotionLimits(robot_type(), Wall(-1.0))
    assert limits.find_obstacle([[0.0, 0.0], [0.0, 0.0]]) is None
    assert limits.find_obstacle([[0.0, 0.0], [0.0, 0.1]]) is not None
