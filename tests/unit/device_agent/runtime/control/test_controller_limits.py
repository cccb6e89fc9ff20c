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

STREAMING_RAD_S = 0.35 * 3.0


def test_a_streamed_arm_stops_before_the_wall_and_reports_it() -> None:
    fixture = leased(Wall())
    assert fixture.stream(1, 4.0) is Mode.STREAMING
    assert WALL_RAD - 0.02 < fixture.elbow <= WALL_RAD + 1e-6
    assert not fixture.controller.moving
    assert "clearance: hand \u2013 wall" in fixture.limited
    rest = fixture.elbow
    for push in range(50):
        fixture.stream(1, 0.05, elbow=1.5 + push * 0.01)
    assert fixture.elbow - rest < 0.01
    assert fixture.elbow <= WALL_RAD + 1e-6
    fixture.stream(1, 1.0, elbow=0.2)
    assert fixture.elbow == pytest.approx(0.2, abs=1e-3)
    assert fixture.controller.update(fixture.now_s + PERIOD_S).limited == ()


def test_a_goal_at_full_speed_stops_before_the_wall() -> None:
    wall = Wall(9.0)
    fixture = ControllerFixture(geometry=wall)
    move = fixture.move(elbow=2.9)
    wall.at_rad = 2.0  # after the check of the target
    fixture.run(3.0)
    assert 1.9 < fixture.elbow <= 2.0
    assert move.result is GoalResult.INTERRUPTED
    assert move.why is not None
    assert (move.why.code, "hand \u2013 wall" in move.why.message) == ("no_room", True)
    assert move.limited == ("clearance: hand \u2013 wall",)
    assert fixture.controller.mode is Mode.ACTION
    fixture.move(elbow=0.0)
    fixture.run(2.5)
    assert fixture.elbow == pytest.approx(0.0, abs=1e-4)


def test_a_goal_without_clearance_is_rejected_with_the_obstacle() -> None:
    fixture = ControllerFixture(geometry=Wall())
    with pytest.raises(Refused, match=r"no clearance at the target: .*hand \u2013 wall, 250 mm") as refused:
        fixture.move(elbow=1.25)
    assert refused.value.code == "no_room"
    fixture.run(0.5)
    assert fixture.elbow == 0.0
    assert fixture.controller.resolve_target(fixture.reservation, {"elbow": 0.5}) == [0.0, 0.5]
    with refuses("no_room"):
        fixture.controller.resolve_target(fixture.reservation, {"elbow": 1.5})


def test_a_robot_that_is_too_near_may_only_move_away() -> None:
    fixture = ControllerFixture(geometry=Wall())
    fixture.controller.start_at([0.0, 1.3])
    with refuses("no_room"):
        fixture.move(elbow=1.4)
    for elbow in (1.2, 0.5):
        fixture.move(elbow=elbow)
        fixture.run(1.0)
    assert fixture.elbow == pytest.approx(0.5, abs=1e-4)


@pytest.mark.parametrize("age_ms", [20, 190])
def test_speed_before_the_wall_falls_with_loop_age(age_ms: int) -> None:
    """The speed is at most the clearance divided by (loop age + watchdog + braking time), all the way."""
    fixture = leased(Wall(1.5))
    for _ in range(200):
        fixture.stream(1, 0.024, age_ms=age_ms)
        velocity = fixture.velocities[-1]
        blind_s = age_ms / 1000 + 0.3 + abs(velocity) / 20.0
        assert velocity <= max(0.02, (1.5 - fixture.elbow) / blind_s) + 1e-3
    assert "speed: loop age" in fixture.limited
    assert fixture.elbow == pytest.approx(1.5, abs=0.02)


@pytest.mark.parametrize(("geometry", "age_ms"), [(Wall(2.9), 40), (None, 90)])
def test_a_low_loop_age_with_clearance_allows_full_speed(geometry: Wall | None, age_ms: int) -> None:
    fixture = leased(geometry)
    fixture.stream(1, 1.2, age_ms=age_ms)
    assert max(fixture.velocities) == pytest.approx(STREAMING_RAD_S, rel=1e-6)
    assert fixture.limited == set()


@pytest.mark.parametrize(("age_ms", "share"), [(150, 0.5), (200, 0.1)])
def test_without_geometry_loop_age_alone_limits_the_speed(age_ms: int, share: float) -> None:
    fixture = leased()
    fixture.stream(1, 1.5, age_ms=age_ms)
    assert fixture.velocities[-1] == pytest.approx(share * STREAMING_RAD_S, rel=1e-3)
    assert fixture.limited == {"speed: loop age"}


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
    move = fixture.move(elbow=1.0)
    fixture.run(0.1)
    fixture.controller.record_applied([0.0, fixture.elbow - 0.01])
    assert fixture.controller.update(fixture.now_s + PERIOD_S).limited == ("elbow: driver",)
    assert move.limited == ("elbow: driver",)
    fixture.controller.record_applied(fixture.controller.commanded_rad)
    assert fixture.controller.update(fixture.now_s + 2 * PERIOD_S).limited == ()


def test_a_geometry_error_in_motion_is_not_permission() -> None:
    class Broken(Wall):
        def sweep(self, path_rad: Sequence[Sequence[float]]) -> Sweep:  # noqa: ARG002
            raise RuntimeError("no shape")

    fixture = ControllerFixture(geometry=Broken())
    fixture.move(elbow=0.5)
    with pytest.raises(RuntimeError):
        fixture.run(0.1)
    fixture.controller.set_fault("internal error")  # as the control loop does
    fixture.run(0.2)
    assert fixture.elbow == pytest.approx(0.0, abs=1e-4)


def test_a_new_target_while_braking_does_not_reverse_the_arm() -> None:
    fixture = leased()
    fixture.stream(1, 1.5, elbow=2.9)
    fixture.grant(2)
    fixture.run(2 * PERIOD_S)
    fixture.velocities.clear()
    fixture.stream(2, 1.0, elbow=2.9)
    assert min(fixture.velocities) > -1e-3
    assert fixture.elbow > 1.0


def test_a_motion_without_a_trajectory_is_an_error() -> None:
    motion = JointMotion(robot_type())
    motion.follow([1.0, 1.0])
    motion._braking = math.nan
    with pytest.raises(MotionError):
        motion.propose()
    with pytest.raises(MotionError):
        generate(lambda *_: Result.ErrorExecutionTimeCalculation, None, None)


def test_a_trajectory_hidden_by_rounding_is_found_at_a_lower_speed() -> None:
    request = InputParameter(1)
    # A joint that would meet both limits, and leave them again, at one moment.
    request.current_position, request.target_position = [0.8000000000000002], [0.5]
    request.max_velocity, request.max_acceleration, request.max_jerk = [3.0], [60.0], [1200.0]
    with pytest.raises(RuckigError):
        Ruckig(1).calculate(request, Trajectory(1))
    trajectory = Trajectory(1)
    generate(Ruckig(1).calculate, request, trajectory)
    assert trajectory.at_time(trajectory.duration)[0] == pytest.approx([0.5])
    assert request.max_velocity == [3.0]


@pytest.mark.parametrize("can_brake", [True, False])
def test_a_motion_that_cannot_be_planned_holds_and_ends_the_lease(can_brake: bool) -> None:
    fixture = leased()
    fixture.stream(1, 0.5)
    motion, rest = fixture.controller._state.motion, fixture.elbow
    motion._jerk_limits = [math.nan, math.nan]
    motion._braking = motion._braking if can_brake else math.nan
    assert fixture.stream(1, 0.024) is Mode.HOLDING
    assert fixture.controller.moving == can_brake, "without a jerk if it can brake"
    assert (fixture.elbow == rest) == (not can_brake)
    assert fixture.at_rest_after(0.3) < 0.1
    assert fixture.lease_epoch is None


def test_limits_are_listed_by_available_model() -> None:
    names = ("position", "velocity", "acceleration", "jerk")
    assert ControllerFixture().controller.limits == names
    assert ControllerFixture(geometry=Wall()).controller.limits == (*names, "clearance")
    box = Workspace(lower_m=(-1, -1, 0), upper_m=(1, 1, 1), frames=("hand",))
    limits = MotionLimits(msgspec.structs.replace(robot_type(), workspace=box), Wall(-1.0))
    assert limits.names == (*names, "clearance", "workspace")
    assert limits.find_obstacle([[0.0, 0.0], [0.0, 0.0]]) is None, "a path without motion is not checked"
    assert limits.find_obstacle([[0.0, 0.0], [0.0, 0.1]]) is not None
