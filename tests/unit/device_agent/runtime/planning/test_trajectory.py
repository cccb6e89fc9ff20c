"""Trajectories: limits, following, braking on the path."""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from device_agent.ports.geometry import Clearance, Sweep, never
from device_agent.protocol import Mode, Pose
from device_agent.runtime.control.goals import GoalResult
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning import trajectory
from device_agent.runtime.planning.motion_planner import MotionPlanner, quaternion_of
from device_agent.runtime.planning.trajectory import Floats, Trajectory
from tests.fakes.drivers import PERIOD_S, robot_type
from tests.harness.agent.controller_fixture import ControllerFixture, Wall, interruptions

JOINTS = robot_type().joints
CORNER = [[0.0, 0.0], [1.2, 0.0], [1.2, 1.0]]


def anywhere(_: Floats) -> bool:
    return True


def along(corners: list[list[float]], *, speed: float = 1.0) -> Trajectory:
    points = trajectory.blend_corners(corners, anywhere)
    assert points is not None
    return trajectory.time_parameterize(points, JOINTS, speed=speed, step_s=PERIOD_S)


def slopes(positions: Floats) -> list[float]:
    """The highest velocity, acceleration and jerk of any joint."""
    found, step = [], positions
    for _ in range(3):
        step = np.diff(step, axis=0) / PERIOD_S
        found.append(float(np.max(np.abs(step), initial=0.0)))
    return found


positions = st.lists(st.floats(-2.9, 2.9), min_size=2, max_size=2)


@settings(max_examples=25, deadline=None)
@given(corners=st.lists(positions, min_size=2, max_size=5), speed=st.floats(0.05, 1.0))
def test_random_corners_stay_within_every_limit(corners: list[list[float]], speed: float) -> None:
    found = along(corners, speed=speed)
    velocity, acceleration, jerk = slopes(found.position_rad)
    assert velocity <= 3.0 * speed * 1.01
    assert acceleration <= 8.0 * 1.02
    assert jerk <= 80.0 * 1.05
    assert found.position_rad[0] == pytest.approx(corners[0], abs=1e-9)
    assert found.position_rad[-1] == pytest.approx(corners[-1], abs=1e-9)
    assert not found.velocity_rad_s[[0, -1]].any()


def test_a_trajectory_to_the_present_position_ends_at_once() -> None:
    found = along([[0.5, 0.1], [0.5, 0.1]])
    assert found.duration_s < 1.0
    assert not found.velocity_rad_s.any()


def test_a_single_segment_is_straight_and_nearly_time_optimal() -> None:
    found = along([[0.0, 0.0], [2.0, 1.0]])
    assert found.position_rad[:, 0] == pytest.approx(2 * found.position_rad[:, 1], abs=1e-9)
    fixture = ControllerFixture()
    reservation = fixture.reserve()
    move = fixture.controller.start_joint_goal(reservation, {"shoulder": 2.0, "elbow": 1.0}, speed=1.0)
    start_s = fixture.now_s
    while not move.finished.is_set():
        fixture.run(PERIOD_S)
    assert found.duration_s <= 1.3 * (fixture.now_s - start_s)


def test_corners_are_blended_as_widely_as_obstacles_allow() -> None:
    def near(path: Floats) -> bool:
        """Only what stays near to the corner's two legs is clear."""
        away = np.minimum(np.abs(path[:, 1]), np.abs(path[:, 0] - 1.2))
        return bool(np.all(away < 0.02))

    wide, narrow = trajectory.blend_corners(CORNER, anywhere), trajectory.blend_corners(CORNER, near)
    assert wide is not None
    assert narrow is not None
    assert len(wide) < len(narrow)
    assert near(trajectory.time_parameterize(narrow, JOINTS, speed=1.0, step_s=PERIOD_S).position_rad)
    assert trajectory.blend_corners(CORNER, lambda _: False) is None


def test_a_trajectory_is_followed_to_rest() -> None:
    fixture, found = ControllerFixture(), along(CORNER)
    reservation = fixture.reserve()
    goal = fixture.controller.start_trajectory(reservation, found)
    gone = ride(fixture, found.duration_s + 0.1)
    assert goal.result is GoalResult.REACHED
    assert gone[: len(found.position_rad) - 1] == pytest.approx(found.position_rad[1:], abs=1e-6)
    assert fixture.controller.commanded_rad == pytest.approx([1.2, 1.0], abs=1e-9)
    assert not fixture.controller.moving


def ride(fixture: ControllerFixture, seconds: float) -> Floats:
    gone = []
    for _ in range(round(seconds / PERIOD_S)):
        fixture.now_s += PERIOD_S
        gone.append(fixture.controller.update(fixture.now_s).position_rad)
    return np.array(gone)


def check_on(found: Trajectory, gone: Floats) -> None:
    """Every place is one of the way's."""
    for place in gone:
        assert float(np.min(np.linalg.norm(found.position_rad - place, axis=1))) < 0.015


@pytest.mark.parametrize("cause", sorted(set(interruptions()) - {"expiry"}))
@pytest.mark.parametrize("after_s", [0.1, 0.45, 0.7])
def test_every_revocation_brakes_on_the_path(cause: str, after_s: float) -> None:
    fixture, found = ControllerFixture(), along(CORNER)
    fixture.take(1, lease_s=5.0)
    reservation = fixture.reserve()
    goal = fixture.controller.start_trajectory(reservation, found)
    before = ride(fixture, after_s)
    assert before[-1] != pytest.approx(before[-2], abs=1e-6)
    interruptions()[cause](fixture)  # type: ignore[operator]
    gone = ride(fixture, 0.3)
    assert goal.result is GoalResult.INTERRUPTED
    assert not fixture.controller.moving
    assert gone[-1] == pytest.approx(gone[-2], abs=1e-6)
    check_on(found, gone)
    assert slopes(np.concatenate((before[-4:], gone)))[1] <= 20.0 + 0.5


def test_a_restriction_slows_a_trajectory_within_the_limits() -> None:
    fixture, found = ControllerFixture(), along(CORNER)
    reservation = fixture.reserve()
    goal = fixture.controller.start_trajectory(reservation, found)
    gone = [ride(fixture, 0.4)]
    fixture.controller.restrict("room", 0.3, "a person is near")
    gone.append(ride(fixture, 1.5))
    slow = np.max(np.abs(np.diff(gone[-1][-40:], axis=0))) / PERIOD_S
    assert slow <= 0.3 * 3.0 + 1e-6
    fixture.controller.lift("room")
    gone.append(ride(fixture, 3.0))
    assert goal.result is GoalResult.REACHED
    assert any("a person is near" in one for one in goal.limited)
    whole = np.concatenate(gone)
    check_on(found, whole)
    assert slopes(whole)[1] <= 8.0 * 1.05


def test_an_obstacle_on_the_trajectory_holds_the_device_before_it() -> None:
    fixture, found = ControllerFixture(geometry=Wall(0.5)), along(CORNER)
    reservation = fixture.reserve()
    goal = fixture.controller.start_trajectory(reservation, found)
    gone = ride(fixture, 3.0)
    assert goal.why is not None
    assert goal.why.code == "no_room"
    assert np.max(gone[:, 1]) <= 0.5 + 1e-6
    check_on(found, gone)


def test_a_late_control_loop_catches_up_braking_on_a_trajectory() -> None:
    fixture, found = ControllerFixture(), along(CORNER)
    reservation = fixture.reserve()
    fixture.controller.start_trajectory(reservation, found)
    ride(fixture, 0.5)
    fixture.controller.end_reservation(reservation)
    ride(fixture, 2 * PERIOD_S)
    fixture.now_s += 0.08
    gone = ride(fixture, 0.15)
    assert not fixture.controller.moving
    check_on(found, gone)


def test_a_new_goal_waits_until_the_trajectory_has_braked() -> None:
    fixture, found = ControllerFixture(), along(CORNER)
    reservation = fixture.reserve()
    goal = fixture.controller.start_trajectory(reservation, found)
    ride(fixture, 0.5)
    move = fixture.controller.start_joint_goal(reservation, {"shoulder": 0.0, "elbow": 0.0}, speed=1.0)
    assert goal.result is GoalResult.INTERRUPTED
    gone = ride(fixture, 3.0)
    assert move.result is GoalResult.REACHED
    assert slopes(gone)[1] <= 20.5


def test_a_trajectory_that_starts_elsewhere_or_leaves_a_range_is_rejected() -> None:
    fixture = ControllerFixture()
    reservation = fixture.reserve()
    for corners, code in (
        ([[0.1, 0.0], [1.0, 0.0]], "moved"),
        ([[0.0, 0.0], [0.0, 3.2]], "out_of_range"),
    ):
        with pytest.raises(Refused) as refused:
            fixture.controller.start_trajectory(reservation, along(corners))
        assert refused.value.code == code
    broken = along([[0.0, 0.0], [1.0, 0.0]])
    broken.position_rad[3, 1] = math.nan
    with pytest.raises(Refused, match="leads elbow out of its range"):
        fixture.controller.start_trajectory(reservation, broken)
    fixture.controller.start_joint_goal(reservation, {"elbow": 1.0}, speed=1.0)
    fixture.run(0.3)
    with pytest.raises(Refused, match="no longer at the start of the trajectory"):
        fixture.controller.start_trajectory(reservation, along(CORNER))
    assert fixture.controller.mode is Mode.ACTION


def test_a_target_is_checked_before_planning() -> None:
    fixture = ControllerFixture(geometry=Wall())
    reservation = fixture.reserve()
    assert fixture.controller.resolve_target(reservation, {"elbow": 0.5}) == [0.0, 0.5]
    with pytest.raises(Refused, match="no room there"):
        fixture.controller.resolve_target(reservation, {"elbow": 1.5})


def test_an_orientation_is_valid_and_unique() -> None:
    poses = {"hand": (0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0)}
    assert quaternion_of(poses, "hand", None, None) == (0.0, 1.0, 0.0, 0.0)
    assert quaternion_of(poses, "hand", (2.0, 0.0, 0.0, 0.0), None) == (1.0, 0.0, 0.0, 0.0)
    assert quaternion_of(poses, "hand", None, (math.pi, 0.0, 0.0)) == pytest.approx((0.0, 1.0, 0.0, 0.0), abs=1e-9)
    for frame, quaternion, rpy in (
        ("foot", None, None),
        ("hand", (0.0, 0.0, 0.0, 0.0), None),
        ("hand", (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ):
        with pytest.raises(Refused):
            quaternion_of(poses, frame, quaternion, rpy)


def test_interpolation_between_samples_is_smooth() -> None:
    found = along(CORNER)
    fine = np.array([found.at(time_s)[0] for time_s in np.arange(-0.1, found.duration_s + 0.1, 0.001)])
    steps = [float(np.linalg.norm(b - a)) for a, b in pairwise(fine)]
    assert max(steps) <= math.hypot(3.0, 3.0) * 0.001 * 1.02
    assert max(abs(b - a) for a, b in pairwise(steps)) <= math.hypot(8.0, 8.0) * 1e-6 * 1.5


def test_after_the_last_iteration_the_trajectory_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trajectory, "_ITERATIONS", 1)
    assert along(CORNER).position_rad[-1] == pytest.approx([1.2, 1.0], abs=1e-9)


class Narrow(Wall):
    """Plans a corner, and calls every way that has one too narrow to go along."""

    def plan(
        self,
        start_rad: Sequence[float],
        goal_rad: Sequence[float],
        *,
        seed: int = 0,
        within_s: float = 5.0,
        ended: Callable[[], bool] = never,
    ) -> tuple[tuple[float, ...], ...]:
        del seed, within_s, ended
        return (tuple(start_rad), (1.0, 0.0), tuple(goal_rad))

    def sweep(self, path_rad: Sequence[Sequence[float]]) -> Sweep:
        del path_rad
        return Sweep(0.0, Clearance(-0.01, ("hand", "wall")))


class Sliding(Narrow):
    """Its hand is where its first joint says."""

    frames = ("hand",)

    def poses(self, position_rad: Sequence[float]) -> Mapping[str, Pose]:
        return {"hand": (position_rad[0], 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)}

    def solve(self, frame: str, pose: Pose, start_rad: Sequence[float]) -> tuple[float, ...]:
        del frame, start_rad
        return (pose[0], 0.0)


def test_a_path_that_is_too_narrow_is_rejected() -> None:
    with pytest.raises(Refused, match="too narrow"):
        MotionPlanner(robot_type(), Narrow()).plan([0.0, 0.0], [1.0, 1.0], speed=1.0, ended=never)
    with pytest.raises(Refused, match="something is in the way: clearance: hand"):
        MotionPlanner(robot_type(), Sliding()).plan_straight([0.0, 0.0], "hand", (0.1, 0, 0, 1, 0, 0, 0), speed=1.0)
