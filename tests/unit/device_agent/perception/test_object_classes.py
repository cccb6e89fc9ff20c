"""Classification by height, position and last sighting: of robots on the floor, and of robots fixed to a table."""

import math

import numpy as np
import pytest

from device_agent.perception.fixed_robots import FixedRobot
from device_agent.perception.object_classes import Mount, ObjectClass
from device_agent.perception.tracker import Tracker

NAO = ObjectClass(name="nao", lowest_m=0.42, highest_m=0.68, radius_m=0.07, fastest_m_s=0.3, start_m=(0.0, 0.0))
QBO = ObjectClass(name="qbo", lowest_m=0.3, highest_m=0.56, radius_m=0.12, fastest_m_s=0.6, start_m=(-0.9, 0.4))
LOW_M = 0.49
"""Height of Qbo and of a sitting NAO."""
CAMERA_M = np.array([3.0, 0.0])
PERIOD_S = 0.2
NEAR_M = 0.15


def cylinder(x_m: float, y_m: float, height_m: float = LOW_M) -> np.ndarray:
    """Points of a depth camera on a cylinder."""
    turn, up = np.meshgrid(np.linspace(-1.3, 1.3, 12), np.linspace(0.1, height_m, 12))
    return np.column_stack((x_m + 0.1 * np.cos(turn.ravel()), y_m + 0.1 * np.sin(turn.ravel()), up.ravel()))


class Floor:
    """Robots on the floor, observed by a depth camera."""

    def __init__(self, *kinds: ObjectClass) -> None:
        self.tracks = Tracker(kinds or (NAO, QBO))
        self.now_s = 0.0

    def observe(self, *robots: tuple[float, float], for_s: float = 2.0, height_m: float = LOW_M) -> None:
        points = np.concatenate([np.zeros((0, 3)), *(cylinder(x, y, height_m) for x, y in robots)])
        for _ in range(round(for_s / PERIOD_S)):
            self.now_s += PERIOD_S
            self.tracks.update("depth", points, CAMERA_M, self.now_s)

    def locates(self, **expected: tuple[float, float]) -> bool:
        """Whether exactly these objects are located, each near its position."""
        positions = self.tracks.positions(self.now_s)
        errors_m = {name: math.dist(at, (positions[name].x_m, positions[name].y_m)) for name, at in expected.items()}
        return set(positions) == set(expected) and max(errors_m.values()) < NEAR_M


@pytest.mark.parametrize("kinds", [(NAO, QBO), (QBO, NAO)])
def test_start_positions_distinguish_equal_heights(kinds: tuple[ObjectClass, ObjectClass]) -> None:
    floor = Floor(*kinds)
    floor.observe((0.2, 0.1), (-0.8, 0.2))
    assert floor.locates(nao=(0.2, 0.1), qbo=(-0.8, 0.2))


def test_the_start_position_decides_while_the_other_robot_is_hidden() -> None:
    floor = Floor()
    floor.observe((0.1, 0.0), for_s=20.0)
    assert floor.locates(nao=(0.1, 0.0))
    floor.observe((0.1, 0.0), (-1.2, 1.0))
    assert floor.locates(nao=(0.1, 0.0), qbo=(-1.2, 1.0))


def test_a_unique_height_decides_at_any_position() -> None:
    floor = Floor()
    floor.observe((-0.9, 0.4), for_s=2.0, height_m=0.58)
    assert floor.locates(nao=(-0.9, 0.4))


def test_the_last_position_takes_precedence_over_the_start() -> None:
    floor = Floor()
    floor.observe((0.0, 0.0), (-0.9, 0.4))
    for share in np.linspace(0, 1, 30):  # around each other, each to the other's start
        angle = math.pi * share
        middle, half = np.array([-0.45, 0.2]), np.array([0.45, -0.2])
        across = np.array([0.2, 0.45]) * math.sin(angle)
        one, other = middle + half * math.cos(angle) + across, middle - half * math.cos(angle) - across
        floor.observe((one[0], one[1]), (other[0], other[1]), for_s=0.4)
    assert floor.locates(nao=(-0.9, 0.4), qbo=(0.0, 0.0))
    floor.observe(for_s=5.0)
    assert floor.locates(nao=(-0.9, 0.4), qbo=(0.0, 0.0)), "still at their last positions"
    floor.observe((0.1, 0.1), (-0.9, 0.5), for_s=3.0)
    assert floor.locates(nao=(-0.9, 0.5), qbo=(0.1, 0.1))


# ---------------------------------------------------------------- fixed to a table

ARM = Mount(name="arm", lowest_m=0.77, highest_m=0.95, radius_m=0.05, near_m=(1.0, 1.0), reach_m=0.9)


def on_table(x_m: float, y_m: float, low_m: float = 0.8) -> np.ndarray:
    """Points of a camera above a robot's base."""
    across, up = np.meshgrid(np.arange(-0.09, 0.1, 0.03), np.arange(-0.09, 0.1, 0.03))
    return np.column_stack((x_m + across.ravel(), y_m + up.ravel(), np.full(across.size, low_m)))


def observe(
    robot: FixedRobot, points_m: np.ndarray, *, from_s: float, for_s: float = 4.0, camera: str = "one"
) -> float:
    now_s = from_s
    for _ in range(round(for_s / PERIOD_S)):
        now_s += PERIOD_S
        assigned = points_m[robot.mask(points_m)]
        robot.update(camera, assigned, CAMERA_M, now_s)
    return now_s


def test_a_fixed_robot_is_reported_when_seen_and_with_its_age_when_hidden() -> None:
    robot = FixedRobot(ARM)
    now_s = observe(robot, on_table(3.0, -1.0), from_s=0.0)
    now_s = observe(robot, on_table(1.7, 1.0), from_s=now_s)  # within reach of its arm, but not a position of its base
    assert robot.position(now_s) is None
    now_s = observe(robot, on_table(1.05, 0.95), from_s=now_s)
    visible = robot.position(now_s)
    assert visible is not None
    assert math.dist((visible.x_m, visible.y_m), (1.05, 0.95)) < 0.1
    assert visible.age_s == pytest.approx(0.0)
    now_s = observe(robot, on_table(1.3, 1.0), from_s=now_s, for_s=6.0)  # a hand within reach is not the base
    hidden = robot.position(now_s)
    assert hidden is not None
    assert hidden.age_s == pytest.approx(6.0, abs=0.01)
    assert (hidden.x_m, hidden.y_m) == pytest.approx((visible.x_m, visible.y_m), abs=0.01)


def test_one_camera_suffices_for_a_fixed_robot() -> None:
    robot = FixedRobot(ARM)
    now_s = 0.0
    for _ in range(4):
        observe(robot, on_table(1.0, 1.0), from_s=now_s, for_s=1.0)
        now_s = observe(robot, np.zeros((0, 3)), from_s=now_s, for_s=1.0, camera="two")
    place = robot.position(now_s)
    assert place is not None
    assert place.age_s == pytest.approx(0.0, abs=0.01)
    assert math.dist((place.x_m, place.y_m), (1.0, 1.0)) < 0.1
