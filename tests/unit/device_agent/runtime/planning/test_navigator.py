"""Navigation: path search and driving to a goal."""

import math
import threading
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Self

import numpy as np
import pytest

from device_agent.perception.occupancy_grid import GridFloorMap, OccupancyGrid
from device_agent.ports.driver import REST, Twist
from device_agent.protocol import GoTo, Measurements
from device_agent.runtime.actions import robot_api
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning import navigator as navigator_module
from device_agent.runtime.planning.grid_search import find_path
from device_agent.runtime.planning.localization import Pose2D
from device_agent.runtime.planning.navigator import BLOCKED_TIMEOUT_S, START_TIMEOUT_S, UPDATE_PERIOD_S, Navigator
from device_agent.runtime.readings import Reading, ReadingCache
from tests.fakes.drivers import BASE, PERIOD_S, robot_type
from tests.harness.agent.controller_fixture import ControllerFixture, refuses
from tests.harness.agent.device_harness import eventually
from tests.unit.device_agent.runtime.actions.robot_api_fixture import device_context

LIMITS = Twist(0.3, 0.0, 1.5)


def room(*walls: tuple[float, float, float, float]) -> OccupancyGrid:
    """Observed floor of four by four metres with boxes (lowest x, y, highest x, y)."""
    grid = OccupancyGrid((-2.0, -2.0), (2.0, 2.0))
    places = np.array([(x, y) for x in np.arange(-1.98, 2, 0.04) for y in np.arange(-1.98, 2, 0.04)])
    taken = np.zeros(len(places), dtype=bool)
    for x0, y0, x1, y1 in walls:
        taken |= (places[:, 0] >= x0) & (places[:, 0] <= x1) & (places[:, 1] >= y0) & (places[:, 1] <= y1)
    for _ in range(5):
        grid.add_points("lidar", places, taken)
    return grid


def navigator_to(goal: tuple[float, float], yaw_rad: float | None = None) -> Navigator:
    return Navigator(goal, yaw_rad, limits=LIMITS, radius_m=0.25)


def moved(pose: Pose2D, twist: Twist, time_s: float) -> Pose2D:
    """The pose of an ideal base after this time."""
    yaw_rad = pose.yaw_rad + twist.turn_rad_s * time_s / 2
    return Pose2D(
        pose.x_m + twist.forward_m_s * time_s * math.cos(yaw_rad),
        pose.y_m + twist.forward_m_s * time_s * math.sin(yaw_rad),
        pose.yaw_rad + twist.turn_rad_s * time_s,
    )


def go(navigator: Navigator, grid: OccupancyGrid, start: Pose2D) -> list[Pose2D]:
    """Poses on the path to the goal."""
    poses = [start]
    for _ in range(round(60 / UPDATE_PERIOD_S)):
        twist = navigator.compute_twist(poses[-1], grid)
        if twist is None:
            return poses
        assert all(abs(part) <= limit + 1e-9 for part, limit in zip(twist, LIMITS, strict=True))
        poses.append(moved(poses[-1], twist, UPDATE_PERIOD_S))
    pytest.fail(f"goal not reached: {poses[-1]}")


@pytest.mark.slow
def test_the_robot_avoids_a_wall_and_reaches_the_heading() -> None:
    grid = room((-0.1, -2.0, 0.1, 0.8))
    poses = go(navigator_to((1.2, -1.0), 1.5), grid, Pose2D(-1.2, -1.0, 2.0))
    assert math.dist((poses[-1].x_m, poses[-1].y_m), (1.2, -1.0)) <= 0.08
    assert poses[-1].yaw_rad == pytest.approx(1.5, abs=0.05)
    blocked = grid.blocked(0.15)
    assert not any(blocked.at(pose.x_m, pose.y_m) for pose in poses)


def test_without_a_heading_any_heading_is_final() -> None:
    poses = go(navigator_to((1.0, 0.0)), room(), Pose2D(0.0, 0.0, 0.0))
    assert abs(poses[-1].yaw_rad) < 0.4


@pytest.mark.parametrize(
    ("goal", "code", "message"),
    [
        ((1.0, 0.0), "no_way", r"nearest reachable place is .*x_m -0\.\d+, y_m -?0\.0"),
        ((0.0, 0.0), "taken", "the place is occupied"),
        ((0.0, 0.3), "taken", r"nearest reachable place is .*y_m 0\.\d+"),
        ((9.0, 0.0), "out_of_room", "The goal is outside"),
    ],
)
def test_unreachable_goals_are_rejected_with_the_nearest_reachable_place(
    goal: tuple[float, float], code: str, message: str
) -> None:
    with pytest.raises(Refused, match=message) as refused:
        navigator_to(goal).compute_twist(Pose2D(-1.0, 0.0, 0.0), room((-0.1, -2.0, 0.1, 2.0)))
    assert refused.value.code == code


def test_a_path_needs_free_cells() -> None:
    floor = GridFloorMap(np.zeros((5, 5), dtype=bool), (0.0, 0.0), 1.0)
    assert find_path(floor, (0.5, 0.5), (4.5, 0.5))[-1] == (4.5, 0.5)
    floor.blocked[:, 2] = True
    with pytest.raises(Refused, match="no free path"):
        find_path(floor, (0.5, 0.5), (4.5, 0.5))
    floor.blocked[:, :] = True
    with pytest.raises(Refused, match=r"or unobserved$"):
        find_path(floor, (0.5, 0.5), (4.5, 0.5))
    diagonal = GridFloorMap(np.eye(6, dtype=bool)[::-1].copy(), (0.0, 0.0), 1.0)
    diagonal.blocked[0, 5] = False
    assert find_path(diagonal, (0.5, 0.5), (5.5, 5.5))[-1] == (5.5, 5.5), "between the obstacles"


def test_a_robot_too_near_to_something_starts_from_the_nearest_free_cell() -> None:
    floor = GridFloorMap(np.zeros((40, 40), dtype=bool), (0.0, 0.0), 0.05)
    floor.blocked[:, :6] = True
    places = find_path(floor, (0.08, 1.0), (1.5, 1.0))
    assert places[0] == pytest.approx((0.325, 1.025))
    floor.blocked[:, :20] = True
    with pytest.raises(Refused, match="no free path"):
        find_path(floor, (0.08, 1.0), (1.5, 1.0))


def test_an_occupied_goal_has_a_short_timeout_before_the_start() -> None:
    navigator = navigator_to((1.0, 0.0))
    taken = Refused("taken", "")
    assert navigator.timeout_s(taken) == START_TIMEOUT_S
    assert navigator.timeout_s(Refused("out_of_room", "")) == 0
    navigator.compute_twist(Pose2D(0.0, 0.0, 0.0), room())
    assert navigator.timeout_s(taken) == BLOCKED_TIMEOUT_S


def test_after_a_rest_the_path_is_searched_anew() -> None:
    navigator, start, wall = navigator_to((1.0, 0.0)), Pose2D(0.0, 0.0, 0.0), room((0.5, -3.0, 0.7, 3.0))
    navigator.compute_twist(start, room())
    assert navigator.compute_twist(start, wall) is not None, "not in each update"
    navigator.replan()
    with refuses("no_way"):
        navigator.compute_twist(start, wall)


def test_at_the_goal_the_robot_only_turns() -> None:
    navigator = navigator_to((0.0, 0.0), 1.0)
    twist = navigator.compute_twist(Pose2D(0.01, 0.0, 0.0), room())
    assert twist is not None
    assert (twist.forward_m_s, twist.left_m_s) == (REST.forward_m_s, REST.left_m_s)
    assert twist.turn_rad_s > 0


class MobileRobot:
    """A base that follows the commands of a ``RobotApi`` in its own thread.

    Args:
        obstacle_map: Floor of the room.
        observed: Odometry at a pose; by default the pose.
        seen: Position and age that the room publishes at a pose; by default nothing.
    """

    def __init__(
        self,
        obstacle_map: OccupancyGrid | None,
        *,
        observed: Callable[[Pose2D], Pose2D] | None = None,
        seen: Callable[[Pose2D], dict[str, float | bool]] | None = None,
    ) -> None:
        self.seen = seen
        self.readings = ReadingCache(space="s", agent="a", own=["room"], named=[("room", "positions")])
        self.fixture = ControllerFixture(base=BASE)
        self.pose = Pose2D(0.0, 0.0, 0.0)
        self.stopping = threading.Event()
        context = replace(
            device_context(robot_type(BASE)),
            controller=self.fixture.controller,
            own_readings=lambda: {"odometry": Reading(asdict(observed(self.pose) if observed else self.pose), 0.0)},
            obstacle_map=lambda: obstacle_map,
            readings=self.readings,
            name="qbo",
        )
        self.publish()
        self.api = RobotApi(context)
        self.api.reserve(1, lambda _: None)
        self.thread = threading.Thread(target=self.run, daemon=True)

    def __enter__(self) -> Self:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.api.release()
        self.stopping.set()
        self.thread.join()

    def run(self) -> None:
        while not self.stopping.wait(PERIOD_S):
            self.fixture.now_s += PERIOD_S
            self.pose = moved(self.pose, self.fixture.controller.update(self.fixture.now_s).twist, PERIOD_S)
            self.publish()

    def position_age_s(self) -> float:
        """Age of the position when the room published it."""
        reading = self.readings.newest("positions", "x_m.qbo")
        assert reading is not None
        return float(reading.values["age_s.qbo"])

    def publish(self) -> None:
        """Publish the position by the room."""
        if self.seen is not None:
            tick_ms = round(self.fixture.now_s * 1000)
            values = self.seen(self.pose)
            measured = Measurements(tick_ms=tick_ms, at_ms=0, sequence=tick_ms, values=values)
            self.readings.record("room", "positions", measured)


@pytest.mark.slow
def test_go_to_reaches_the_goal_and_rests() -> None:
    with MobileRobot(room()) as robot:
        robot.api.execute(GoTo(x_m=0.3, y_m=0.0, yaw_rad=0.3))
        assert math.dist((robot.pose.x_m, robot.pose.y_m), (0.3, 0.0)) < 0.15
        assert not robot.fixture.controller.moving


@pytest.mark.parametrize(("correct_after", "arrives"), [(1, True), (99, False)])
def test_go_to_corrects_the_pose_at_rest_and_fails_if_the_robot_is_not_at_the_goal(
    correct_after: int, arrives: bool
) -> None:
    rests = 0

    def observed(pose: Pose2D) -> Pose2D:
        """The position is late in motion: it is 0.2 m further back once the robot rests."""
        nonlocal rests
        late = not robot.fixture.controller.moving and pose.x_m > 0.1
        rests += late
        return replace(pose, x_m=pose.x_m - 0.2) if late and rests <= 12 * correct_after else pose

    with MobileRobot(room(), observed=observed) as robot:
        if arrives:
            robot.api.execute(GoTo(x_m=0.3, y_m=0.0))
        else:
            with refuses("not_arrived"):
                robot.api.execute(GoTo(x_m=0.3, y_m=0.0))


@pytest.mark.parametrize(("seen_age_s", "code"), [(0.0, "position_conflict"), (16.0, "no_position")])
def test_go_to_does_not_report_the_arrival_of_a_robot_that_only_its_wheels_report(
    seen_age_s: float, code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(robot_api, "UNSEEN_TIMEOUT_S", 0.2)

    def seen(pose: Pose2D) -> dict[str, float | bool]:
        """The robot is blocked at 0.1 m, where the room sees it or has lost it, and its wheels slip."""
        blocked = pose.x_m > 0.1
        return {"x_m.qbo": min(pose.x_m, 0.1), "y_m.qbo": pose.y_m, "age_s.qbo": seen_age_s if blocked else 0.0}

    with MobileRobot(room(), seen=seen) as robot:
        with refuses(code):
            robot.api.execute(GoTo(x_m=0.6, y_m=0.0))
        x_m = robot.pose.x_m
        eventually(lambda: not robot.fixture.controller.moving)
        assert robot.pose.x_m - x_m < 0.08, "it brakes at once; the last drive would last 0.3 s"


def test_go_to_rests_while_a_person_hides_the_robot_from_the_room() -> None:
    age_s = 0.0

    def seen(pose: Pose2D) -> dict[str, float | bool]:
        return {"x_m.qbo": pose.x_m, "y_m.qbo": pose.y_m, "age_s.qbo": age_s}

    def show() -> None:
        nonlocal age_s
        age_s = 0.0

    with MobileRobot(room(), seen=seen) as robot:
        robot.api.execute(GoTo(x_m=0.2, y_m=0.0))
        age_s = 16.0
        eventually(lambda: robot.position_age_s() == age_s)
        threading.Timer(0.5, show).start()
        robot.api.execute(GoTo(x_m=0.4, y_m=0.0))
        assert age_s == 0.0
        assert math.dist((robot.pose.x_m, robot.pose.y_m), (0.4, 0.0)) < 0.15


def test_arrival_at_rest_is_measured_against_position_and_heading() -> None:
    navigator = navigator_to((1.0, 0.0), 0.0)
    navigator.require_arrival(Pose2D(1.05, 0.0, 0.05))
    for pose in (Pose2D(1.1, 0.0, 0.0), Pose2D(1.0, 0.0, 0.2)):
        with refuses("not_arrived"):
            navigator.require_arrival(pose)


@pytest.mark.parametrize(
    ("obstacle_map", "x_m", "code"),
    [(None, 1.0, "no_ground"), (room((0.5, -2, 0.7, 2)), 0.6, "taken"), (room(), 9.0, "out_of_room")],
)
def test_go_to_without_a_map_or_after_the_timeout_is_rejected(
    monkeypatch: pytest.MonkeyPatch, obstacle_map: OccupancyGrid | None, x_m: float, code: str
) -> None:
    monkeypatch.setattr(navigator_module, "BLOCKED_TIMEOUT_S", 0.15)
    monkeypatch.setattr(navigator_module, "START_TIMEOUT_S", 0.15)
    with MobileRobot(obstacle_map) as robot, refuses(code):
        robot.api.execute(GoTo(x_m=x_m, y_m=0.0))


def test_go_to_ends_with_the_reservation() -> None:
    with MobileRobot(room()) as robot:
        threading.Timer(0.3, robot.fixture.stop).start()
        with pytest.raises(Refused, match="stopped"):
            robot.api.execute(GoTo(x_m=1.5, y_m=0.0))
    with pytest.raises(Refused):
        robot.api.execute(GoTo(x_m=1.5, y_m=0.0))


def test_go_to_needs_finite_numbers_and_a_base() -> None:
    with pytest.raises(Refused, match="does not drive"):
        Navigator.for_robot(0.0, 0.0, None, robot_type())
    with pytest.raises(Refused, match="finite"):
        Navigator.for_robot(math.nan, 0.0, None, robot_type(BASE))
