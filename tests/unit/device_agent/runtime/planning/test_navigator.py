"""Navigation: localization, path search and driving to a goal."""

import math
import threading
from dataclasses import asdict

import numpy as np
import pytest

from device_agent.perception.occupancy_grid import GridFloorMap, OccupancyGrid
from device_agent.ports.driver import REST, Twist
from device_agent.protocol import GoTo, StopLatch
from device_agent.runtime.actions.device_context import DeviceContext
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning import navigator as navigator_module
from device_agent.runtime.planning.grid_search import find_path
from device_agent.runtime.planning.localization import Pose2D, PoseEstimator
from device_agent.runtime.planning.navigator import BLOCKED_TIMEOUT_S, START_TIMEOUT_S, UPDATE_PERIOD_S, Navigator
from device_agent.runtime.readings import Reading, ReadingCache
from tests.fakes.drivers import BASE, PERIOD_S, robot_type
from tests.harness.agent.controller_fixture import ControllerFixture

LIMITS = Twist(0.3, 0.0, 1.5)


def room(*walls: tuple[float, float, float, float]) -> OccupancyGrid:
    """Four by four metres, seen, with boxes (lowest x, y, highest x, y)."""
    grid = OccupancyGrid((-2.0, -2.0), (2.0, 2.0))
    places = np.array([(x, y) for x in np.arange(-1.98, 2, 0.04) for y in np.arange(-1.98, 2, 0.04)])
    taken = np.zeros(len(places), dtype=bool)
    for x0, y0, x1, y1 in walls:
        taken |= (places[:, 0] >= x0) & (places[:, 0] <= x1) & (places[:, 1] >= y0) & (places[:, 1] <= y1)
    for _ in range(5):
        grid.add_points("lidar", places, taken)
    return grid


def go(navigator: Navigator, grid: OccupancyGrid, place: Pose2D, *, seconds: float = 60.0) -> list[Pose2D]:
    """Where an ideal base comes."""
    places = [place]
    for _ in range(round(seconds / UPDATE_PERIOD_S)):
        twist = navigator.compute_twist(places[-1], grid)
        if twist is None:
            return places
        assert all(abs(part) <= most + 1e-9 for part, most in zip(twist, LIMITS, strict=True))
        last = places[-1]
        yaw = last.yaw_rad + twist.turn_rad_s * UPDATE_PERIOD_S / 2
        places.append(
            Pose2D(
                last.x_m + twist.forward_m_s * UPDATE_PERIOD_S * math.cos(yaw),
                last.y_m + twist.forward_m_s * UPDATE_PERIOD_S * math.sin(yaw),
                last.yaw_rad + twist.turn_rad_s * UPDATE_PERIOD_S,
            )
        )
    pytest.fail(f"not there: {places[-1]}")


def test_the_robot_avoids_a_wall_and_reaches_the_heading() -> None:
    grid = room((-0.1, -2.0, 0.1, 0.8))
    navigator = Navigator((1.2, -1.0), 1.5, limits=LIMITS, radius_m=0.25)
    places = go(navigator, grid, Pose2D(-1.2, -1.0, 2.0))
    assert math.dist((places[-1].x_m, places[-1].y_m), (1.2, -1.0)) <= 0.08
    assert places[-1].yaw_rad == pytest.approx(1.5, abs=0.05)
    taken = grid.blocked(0.15)
    assert not any(taken.at(place.x_m, place.y_m) for place in places)


def test_without_a_heading_any_heading_is_final() -> None:
    places = go(Navigator((1.0, 0.0), None, limits=LIMITS, radius_m=0.25), room(), Pose2D(0.0, 0.0, 0.0))
    assert abs(places[-1].yaw_rad) < 0.4


def test_unreachable_goals_are_rejected() -> None:
    shut = room((-0.1, -2.0, 0.1, 2.0))
    for goal, code in (((1.0, 0.0), "no_way"), ((0.0, 0.0), "taken"), ((9.0, 0.0), "out_of_room")):
        with pytest.raises(Refused) as refused:
            Navigator(goal, None, limits=LIMITS, radius_m=0.25).compute_twist(Pose2D(-1.0, 0.0, 0.0), shut)
        assert refused.value.code == code


def test_a_person_in_the_way_is_avoided_or_waited_for() -> None:
    floor = GridFloorMap(np.zeros((5, 5), dtype=bool), (0.0, 0.0), 1.0)
    assert find_path(floor, (0.5, 0.5), (4.5, 0.5))[-1] == (4.5, 0.5)
    floor.blocked[:, 2] = True
    with pytest.raises(Refused, match="no free path"):
        find_path(floor, (0.5, 0.5), (4.5, 0.5))


def test_a_rejection_names_the_nearest_reachable_place() -> None:
    for goal, code, near in (((1.0, 0.0), "no_way", r"x_m -0\.\d+, y_m -?0\.0"), ((0.0, 0.3), "taken", r"y_m 0\.\d+")):
        with pytest.raises(Refused, match=f"nearest reachable place is .*{near}") as refused:
            Navigator(goal, None, limits=LIMITS, radius_m=0.25).compute_twist(
                Pose2D(-1.0, 0.0, 0.0), room((-0.1, -2.0, 0.1, 2.0))
            )
        assert refused.value.code == code
    full = GridFloorMap(np.ones((5, 5), dtype=bool), (0.0, 0.0), 1.0)
    with pytest.raises(Refused, match=r"or it is unseen$"):
        find_path(full, (0.5, 0.5), (4.5, 0.5))


def test_a_robot_too_near_to_something_starts_from_the_nearest_free_cell() -> None:
    floor = GridFloorMap(np.zeros((40, 40), dtype=bool), (0.0, 0.0), 0.05)
    floor.blocked[:, :6] = True
    places = find_path(floor, (0.08, 1.0), (1.5, 1.0))
    assert places[0] == pytest.approx((0.325, 1.025))
    floor.blocked[:, :20] = True
    with pytest.raises(Refused, match="no free path"):
        find_path(floor, (0.08, 1.0), (1.5, 1.0))


def test_a_path_leads_between_obstacles() -> None:
    floor = GridFloorMap(np.eye(6, dtype=bool)[::-1].copy(), (0.0, 0.0), 1.0)
    floor.blocked[0, 5] = False
    assert find_path(floor, (0.5, 0.5), (5.5, 5.5))[-1] == (5.5, 5.5)


def test_an_occupied_goal_has_a_short_timeout_before_the_start() -> None:
    navigator = Navigator((1.0, 0.0), None, limits=LIMITS, radius_m=0.25)
    taken = Refused("taken", "")
    assert navigator.timeout_s(taken) == START_TIMEOUT_S
    assert navigator.timeout_s(Refused("out_of_room", "")) == 0
    navigator.compute_twist(Pose2D(0.0, 0.0, 0.0), room())
    assert navigator.timeout_s(taken) == BLOCKED_TIMEOUT_S


def test_room_positions_correct_the_odometry() -> None:
    where = PoseEstimator("qbo")
    wheels = Reading({"x_m": 1.0, "y_m": 0.0, "yaw_rad": 0.5}, 0.02)
    seen = Reading({"x_m.qbo": 1.2, "y_m.qbo": 0.1, "age_s.qbo": 0.2}, 0.1)
    assert where.estimate(wheels, None) == Pose2D(1.0, 0.0, 0.5)
    found = where.estimate(wheels, seen)
    assert (found.x_m, found.y_m, found.yaw_rad) == pytest.approx((1.2, 0.1, 0.5))
    assert where.estimate(wheels, None).x_m == pytest.approx(1.2), "what it has learned stays"


def test_without_odometry_the_room_position_is_used() -> None:
    seen = Reading({"x_m.nao": 1.2, "y_m.nao": 0.1, "yaw_rad.nao": 0.3}, 0.1)
    assert PoseEstimator("nao").estimate(None, seen) == Pose2D(1.2, 0.1, 0.3)


@pytest.mark.parametrize(
    "seen",
    [
        None,
        Reading({"x_m.nao": 1.2, "y_m.nao": 0.1}, 0.1),
        Reading({"x_m.nao": 1.2, "y_m.nao": 0.1, "yaw_rad.nao": 0.3}, 1.5),
        Reading({"x_m.nao": 1.2, "y_m.nao": 0.1, "yaw_rad.nao": 0.3, "age_s.nao": 2.0}, 0.1),
        Reading({"x_m.nao": math.nan, "y_m.nao": 0.1, "yaw_rad.nao": 0.3}, 0.1),
        Reading({"x_m.qbo": 1.2, "y_m.qbo": 0.1, "yaw_rad.qbo": 0.3}, 0.1),
    ],
)
def test_a_robot_without_a_position_does_not_drive(seen: Reading | None) -> None:
    with pytest.raises(Refused, match="the position of the robot is unknown"):
        PoseEstimator("nao").estimate(None, seen)


def test_at_the_goal_the_robot_only_turns() -> None:
    navigator = Navigator((0.0, 0.0), 1.0, limits=LIMITS, radius_m=0.25)
    twist = navigator.compute_twist(Pose2D(0.01, 0.0, 0.0), room())
    assert twist is not None
    assert (twist.forward_m_s, twist.left_m_s) == (REST.forward_m_s, REST.left_m_s)
    assert twist.turn_rad_s > 0


class Toy:
    """A base that follows commands in its own thread."""

    def __init__(self, ground: OccupancyGrid | None) -> None:
        self.fixture = ControllerFixture(base=BASE)
        self.at = Pose2D(0.0, 0.0, 0.0)
        self.over = threading.Event()
        body = DeviceContext(
            robot_type=robot_type(BASE),
            controller=self.fixture.controller,
            observe=lambda: None,
            geometry=None,
            skills=None,
            readings=ReadingCache(space="s", agent="a", own=["toy"]),
            own_readings=lambda: {"odometry": Reading(asdict(self.at), 0.0)},
            name="toy",
            obstacle_map=lambda: ground,
        )
        self.robot = RobotApi(body)
        self.robot.reserve(1, lambda _: None)
        self.thread = threading.Thread(target=self.live, daemon=True)
        self.thread.start()

    def live(self) -> None:
        while not self.over.wait(PERIOD_S):
            self.fixture.now_s += PERIOD_S
            twist = self.fixture.controller.update(self.fixture.now_s).twist
            at = self.at
            self.at = Pose2D(
                at.x_m + twist.forward_m_s * PERIOD_S * math.cos(at.yaw_rad),
                at.y_m + twist.forward_m_s * PERIOD_S * math.sin(at.yaw_rad),
                at.yaw_rad + twist.turn_rad_s * PERIOD_S,
            )

    def end(self) -> None:
        self.robot.release()
        self.over.set()
        self.thread.join()


def test_go_to_reaches_the_goal_and_rests() -> None:
    toy = Toy(room())
    toy.robot.execute(GoTo(x_m=0.3, y_m=0.0, yaw_rad=0.3))
    assert math.dist((toy.at.x_m, toy.at.y_m), (0.3, 0.0)) < 0.15
    assert not toy.fixture.controller.moving
    toy.end()


def test_go_to_without_a_map_or_after_the_timeout_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(navigator_module, "BLOCKED_TIMEOUT_S", 0.15)
    monkeypatch.setattr(navigator_module, "START_TIMEOUT_S", 0.15)
    shut = room((0.5, -2, 0.7, 2))
    for ground, x_m, code in ((None, 1.0, "no_ground"), (shut, 0.6, "taken"), (room(), 9.0, "out_of_room")):
        toy = Toy(ground)
        with pytest.raises(Refused) as refused:
            toy.robot.execute(GoTo(x_m=x_m, y_m=0.0))
        assert refused.value.code == code
        toy.end()


def test_go_to_ends_with_the_reservation() -> None:
    toy = Toy(room())
    threading.Timer(0.3, lambda: toy.fixture.controller.stop(StopLatch(caller="ann", reason="", at_ms=0))).start()
    with pytest.raises(Refused, match="stopped"):
        toy.robot.execute(GoTo(x_m=1.5, y_m=0.0))
    toy.end()
    with pytest.raises(Refused):
        toy.robot.execute(GoTo(x_m=1.5, y_m=0.0))


def test_go_to_needs_finite_numbers_and_a_base() -> None:
    with pytest.raises(Refused, match="does not drive"):
        Navigator.for_robot(0.0, 0.0, None, robot_type())
    with pytest.raises(Refused, match="finite"):
        Navigator.for_robot(math.nan, 0.0, None, robot_type(BASE))
