"""Trajectories: limits, following, braking on the path."""

import math
from collections.abc import Mapping, Sequence
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
from tests.harness.agent.controller_fixture import ControllerFixture, Wall, interruptions, refuses

JOINTS = robot_type().joints
CORNER = [[0.0, 0.0], [1.2, 0.0], [1.2, 1.0]]


def anywhere(_: Floats) -> bool:
    return True


def along(corners: list[list[float]], *, speed: float = 1.0) -> Trajectory:
    points = trajectory.blend_corners(corners, anywhere)
    assert points is not None
    return trajectory.time_parameterize(points, JOINTS, speed=speed, step_s=PERIOD_S)


class PathFixture(ControllerFixture):
    """A controller that follows a path."""

    def __init__(self, corners: list[list[float]] = CORNER, *, geometry: Wall | None = None) -> None:
        super().__init__(geometry=geometry)
        self.grant(1, lease_s=5.0)
        self.path = along(corners)
        self.goal = self.controller.start_trajectory(self.reservation, self.path)

    def follow(self, seconds: float) -> Floats:
        """Positions during this time, shape (periods, 2)."""
        self.outputs.clear()
        self.run(seconds)
        return np.array([output.position_rad for output in self.outputs])

    def check_on_path(self, positions: Floats) -> None:
        for position in positions:
            assert float(np.min(np.linalg.norm(self.path.position_rad - position, axis=1))) < 0.015


def derivatives(positions: Floats) -> list[float]:
    """The highest velocity, acceleration and jerk of any joint."""
    return [float(np.max(np.abs(np.diff(positions, n=n, axis=0)), initial=0.0)) / PERIOD_S**n for n in (1, 2, 3)]


positions = st.lists(st.floats(-2.9, 2.9), min_size=2, max_size=2)


@settings(max_examples=25)
@given(corners=st.lists(positions, min_size=2, max_size=5), speed=st.floats(0.05, 1.0))
def test_random_corners_stay_within_every_limit(corners: list[list[float]], speed: float) -> None:
    path = along(corners, speed=speed)
    velocity, acceleration, jerk = derivatives(path.position_rad)
    assert velocity <= 3.0 * speed * 1.01
    assert acceleration <= 8.0 * 1.02
    assert jerk <= 80.0 * 1.05
    assert path.position_rad[0] == pytest.approx(corners[0], abs=1e-9)
    assert path.position_rad[-1] == pytest.approx(corners[-1], abs=1e-9)
    assert not path.velocity_rad_s[[0, -1]].any()


def test_a_single_segment_is_straight_and_nearly_time_optimal() -> None:
    resting = along([[0.5, 0.1], [0.5, 0.1]])
    assert resting.duration_s < 1.0
    assert not resting.velocity_rad_s.any()
    path = along([[0.0, 0.0], [2.0, 1.0]])
    assert path.position_rad[:, 0] == pytest.approx(2 * path.position_rad[:, 1], abs=1e-9)
    fixture = ControllerFixture()
    start_s, move = fixture.now_s, fixture.move(shoulder=2.0, elbow=1.0)
    while not move.finished.is_set():
        fixture.run(PERIOD_S)
    assert path.duration_s <= 1.3 * (fixture.now_s - start_s)


def test_corners_are_blended_as_widely_as_obstacles_allow() -> None:
    def near(path: Floats) -> bool:
        """Whether a path stays near to the two legs of the corner."""
        return bool(np.all(np.minimum(np.abs(path[:, 1]), np.abs(path[:, 0] - 1.2)) < 0.02))

    wide, narrow = trajectory.blend_corners(CORNER, anywhere), trajectory.blend_corners(CORNER, near)
    assert wide is not None
    assert narrow is not None
    assert len(wide) < len(narrow)
    assert near(trajectory.time_parameterize(narrow, JOINTS, speed=1.0, step_s=PERIOD_S).position_rad)
    assert trajectory.blend_corners(CORNER, lambda _: False) is None


def test_a_trajectory_is_followed_to_rest() -> None:
    fixture = PathFixture()
    positions = fixture.follow(fixture.path.duration_s + 0.1)
    assert fixture.goal.result is GoalResult.REACHED
    assert positions[: len(fixture.path.position_rad) - 1] == pytest.approx(fixture.path.position_rad[1:], abs=1e-6)
    assert fixture.controller.commanded_rad == pytest.approx([1.2, 1.0], abs=1e-9)
    assert not fixture.controller.moving


@pytest.mark.parametrize("cause", sorted(set(interruptions()) - {"expiry"}))
@pytest.mark.parametrize("after_s", [0.1, 0.45, 0.7])
def test_every_revocation_brakes_on_the_path(cause: str, after_s: float) -> None:
    fixture = PathFixture()
    before = fixture.follow(after_s)
    assert before[-1] != pytest.approx(before[-2], abs=1e-6)
    interruptions()[cause](fixture)
    positions = fixture.follow(0.3)
    assert fixture.goal.result is GoalResult.INTERRUPTED
    assert not fixture.controller.moving
    assert positions[-1] == pytest.approx(positions[-2], abs=1e-6)
    fixture.check_on_path(positions)
    assert derivatives(np.concatenate((before[-4:], positions)))[1] <= 20.0 + 0.5


def test_a_restriction_slows_a_trajectory_within_the_limits() -> None:
    fixture = PathFixture()
    full = fixture.follow(0.4)
    fixture.controller.restrict("room", 0.3, "a person is near")
    slow = fixture.follow(1.5)
    assert derivatives(slow[-40:])[0] <= 0.3 * 3.0 + 1e-6
    fixture.controller.lift("room")
    positions = np.concatenate((full, slow, fixture.follow(3.0)))
    assert fixture.goal.result is GoalResult.REACHED
    assert any("a person is near" in limit for limit in fixture.goal.limited)
    fixture.check_on_path(positions)
    assert derivatives(positions)[1] <= 8.0 * 1.05


def test_an_obstacle_on_the_trajectory_holds_the_device_before_it() -> None:
    fixture = PathFixture(geometry=Wall(0.5))
    positions = fixture.follow(3.0)
    assert fixture.goal.why is not None
    assert fixture.goal.why.code == "no_room"
    assert np.max(positions[:, 1]) <= 0.5 + 1e-6
    fixture.check_on_path(positions)


def test_a_late_control_loop_catches_up_braking_on_a_trajectory() -> None:
    fixture = PathFixture()
    fixture.follow(0.5)
    fixture.controller.end_reservation(fixture.reservation)
    fixture.follow(2 * PERIOD_S)
    fixture.now_s += 0.08
    positions = fixture.follow(0.15)
    assert not fixture.controller.moving
    fixture.check_on_path(positions)


def test_a_new_goal_waits_until_the_trajectory_has_braked() -> None:
    fixture = PathFixture()
    fixture.follow(0.5)
    move = fixture.move(shoulder=0.0, elbow=0.0)
    assert fixture.goal.result is GoalResult.INTERRUPTED
    positions = fixture.follow(3.0)
    assert move.result is GoalResult.REACHED
    assert derivatives(positions)[1] <= 20.5


def test_a_trajectory_that_starts_elsewhere_or_leaves_a_range_is_rejected() -> None:
    fixture = ControllerFixture()
    for corners, code in (([[0.1, 0.0], [1.0, 0.0]], "moved"), ([[0.0, 0.0], [0.0, 3.2]], "out_of_range")):
        with refuses(code):
            fixture.controller.start_trajectory(fixture.reservation, along(corners))
    broken = along([[0.0, 0.0], [1.0, 0.0]])
    broken.position_rad[3, 1] = math.nan
    with pytest.raises(Refused, match="leads elbow out of its range"):
        fixture.controller.start_trajectory(fixture.reservation, broken)
    fixture.move(elbow=1.0)
    fixture.run(0.3)
    with pytest.raises(Refused, match="no longer at the start of the trajectory"):
        fixture.controller.start_trajectory(fixture.reservation, along(CORNER))
    assert fixture.controller.mode is Mode.ACTION


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
    path = along(CORNER)
    fine = np.array([path.at(time_s)[0] for time_s in np.arange(-0.1, path.duration_s + 0.1, 0.001)])
    steps = [float(np.linalg.norm(b - a)) for a, b in pairwise(fine)]
    assert max(steps) <= math.hypot(3.0, 3.0) * 0.001 * 1.02
    assert max(abs(b - a) for a, b in pairwise(steps)) <= math.hypot(8.0, 8.0) * 1e-6 * 1.5


def test_after_the_last_iteration_the_trajectory_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trajectory, "_ITERATIONS", 1)
    assert along(CORNER).position_rad[-1] == pytest.approx([1.2, 1.0], abs=1e-9)


class NarrowGeometry(Wall):
    """Plans a corner, and finds no clearance on any path. The first joint moves the hand along a line."""

    frames = ("hand",)

    def plan(self, start_rad: Sequence[float], goal_rad: Sequence[float], **_: object) -> tuple[tuple[float, ...], ...]:
        return (tuple(start_rad), (1.0, 0.0), tuple(goal_rad))

    def sweep(self, path_rad: Sequence[Sequence[float]]) -> Sweep:
        del path_rad
        return Sweep(0.0, Clearance(-0.01, ("hand", "wall")))

    def poses(self, position_rad: Sequence[float]) -> Mapping[str, Pose]:
        return {"hand": (position_rad[0], 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)}

    def solve(self, frame: str, pose: Pose, start_rad: Sequence[float]) -> tuple[float, ...]:
        del frame, start_rad
        return (pose[0], 0.0)


def test_a_path_that_is_too_narrow_is_rejected() -> None:
    planner = MotionPlanner(robot_type(), NarrowGeometry())
    with pytest.raises(Refused, match="too narrow"):
        planner.plan([0.0, 0.0], [1.0, 1.0], speed=1.0, ended=never)
    with pytest.raises(Refused, match="an obstacle is in the way: clearance: hand"):
        planner.plan_straight([0.0, 0.0], "hand", (0.1, 0, 0, 1, 0, 0, 0), speed=1.0)
