"""Motion planning around obstacles and on straight lines."""

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest

from device_agent.geometry.mujoco_geometry import MujocoGeometry
from device_agent.ports.geometry import GeometryError, PlannerLostError
from device_agent.protocol.manifests import robot_type
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.control.goals import GoalResult
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.motion_planner import MotionPlanner
from tests.harness.paths import UR5

KIND = robot_type.load(UR5)
HOME = [KIND.home_rad[joint.name] for joint in KIND.joints]
BEYOND = [1.6, *HOME[1:]]
PERIOD_S = KIND.period_ms / 1000
POST = '<geom name="post" type="cylinder" size="0.04 0.35" pos="-0.249 -0.414 0.35"/>'


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The table with a post on it, half way between the arm at home and where it shall go."""
    folder = tmp_path_factory.mktemp("ur5")
    (folder / "ur5.xml").write_bytes((UR5 / "ur5.xml").read_bytes())
    text = (UR5 / KIND.scene).read_text().replace("<worldbody>", f"<worldbody>{POST}", 1)
    (folder / KIND.scene).write_text(text)
    return folder / KIND.scene


@pytest.fixture(scope="module")
def shape(scene: Path) -> MujocoGeometry:
    return MujocoGeometry(KIND, scene)


class Physics:
    """The arm in MuJoCo, moved by the agent's own controller."""

    def __init__(self, scene: Path, shape: MujocoGeometry) -> None:
        self.model = mujoco.MjModel.from_xml_path(str(scene))
        self.model.opt.timestep = 0.002
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = self.data.ctrl[:] = HOME
        self.controller = Controller(KIND, LeaseGate(), geometry=shape)
        self.controller.start_at(HOME)
        self.reservation = self.controller.reserve(epoch=1, on_revoked=lambda _: None)
        self.now_s = 0.0
        self.touched = 0

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD_S)):
            self.now_s += PERIOD_S
            self.data.ctrl[:] = self.controller.update(self.now_s).position_rad
            mujoco.mj_step(self.model, self.data, nstep=round(PERIOD_S / 0.002))
            self.touched += self.data.ncon

    def flange_m(self) -> list[float]:
        place: list[float] = self.data.site("flange").xpos.tolist()
        return place


def check_around(scene: Path, shape: MujocoGeometry, seed: int) -> float:
    """Plan with this seed, go, and give how far the flange then is from where it should be [m]."""
    physics, routes = Physics(scene, shape), MotionPlanner(KIND, shape, seed=seed)
    way = routes.plan(HOME, BEYOND, speed=1.0, ended=lambda: False)
    goal = physics.controller.start_trajectory(physics.reservation, way)
    physics.run(way.duration_s + 1.5)
    assert goal.result is GoalResult.REACHED, goal.why
    assert goal.limited == ()
    assert physics.touched == 0
    return math.dist(physics.flange_m(), shape.poses(BEYOND)["flange"][:3])


def test_the_straight_path_collides_with_the_post(shape: MujocoGeometry) -> None:
    swept = shape.sweep([HOME, BEYOND])
    assert swept.clearance is not None
    assert "post" in swept.clearance.text


@pytest.mark.parametrize("seed", range(3))
def test_a_plan_avoids_the_post_and_reaches_the_goal(scene: Path, shape: MujocoGeometry, seed: int) -> None:
    assert check_around(scene, shape, seed) <= 0.001


@pytest.mark.long
def test_planning_succeeds_with_twenty_seeds(scene: Path, shape: MujocoGeometry) -> None:
    errors_m = [check_around(scene, shape, 100 + seed) for seed in range(20)]
    assert max(errors_m) <= 0.001


def test_a_straight_path_is_straight_in_simulation(scene: Path, shape: MujocoGeometry) -> None:
    physics = Physics(scene, shape)
    begin = shape.poses(HOME)["flange"]
    pose = (begin[0], begin[1] + 0.25, begin[2] - 0.05, *begin[3:])
    way = MotionPlanner(KIND, shape).plan_straight(HOME, "flange", pose, speed=0.5)
    physics.controller.start_trajectory(physics.reservation, way)
    line, off_m = np.subtract(pose[:3], begin[:3]), []
    for _ in range(round(way.duration_s / PERIOD_S) + 100):
        physics.run(PERIOD_S)
        away = np.subtract(physics.flange_m(), begin[:3])
        off_m.append(float(np.linalg.norm(away - line * (away @ line) / (line @ line))))
    assert math.dist(physics.flange_m(), pose[:3]) <= 0.001
    assert max(off_m) <= 0.004
    commanded = [shape.poses(place.tolist())["flange"] for place in way.position_rad[::5]]
    ways = [np.subtract(place[:3], begin[:3]) for place in commanded]
    assert max(float(np.linalg.norm(one - line * (one @ line) / (line @ line))) for one in ways) <= 0.0005


def test_a_goal_without_clearance_is_rejected_with_the_obstacle(shape: MujocoGeometry) -> None:
    with pytest.raises(GeometryError, match="the goal is not clear: clearance: post"):
        shape.plan(HOME, [0.8, *HOME[1:]])


def test_a_search_times_out(shape: MujocoGeometry) -> None:
    with pytest.raises(GeometryError, match="found no path in 0 s"):
        shape.plan(HOME, BEYOND, within_s=0.0)


def test_a_cancelled_search_returns_at_once(shape: MujocoGeometry) -> None:
    with pytest.raises(GeometryError, match="cancelled"):
        shape.plan(HOME, BEYOND, ended=lambda: True)


def test_a_lost_planner_is_reported(shape: MujocoGeometry, monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(*_: object, **__: object) -> None:
        raise PlannerLostError("the planner process has ended; try again")

    monkeypatch.setattr(shape, "plan", lost)
    with pytest.raises(Refused, match="try again") as refused:
        MotionPlanner(KIND, shape).plan(HOME, BEYOND, speed=1.0, ended=lambda: False)
    assert refused.value.code == "planner_lost"


def test_the_same_seed_gives_the_same_plan(shape: MujocoGeometry) -> None:
    assert shape.plan(HOME, BEYOND, seed=7) == shape.plan(HOME, BEYOND, seed=7)
    assert shape.plan(HOME, BEYOND, seed=7) != shape.plan(HOME, BEYOND, seed=8)


def test_every_segment_of_a_plan_passes_the_clearance_check(shape: MujocoGeometry) -> None:
    path = shape.plan(HOME, BEYOND, seed=3)
    assert (path[0], path[-1]) == (tuple(HOME), tuple(BEYOND))
    assert shape.sweep(path).clearance is None


def test_a_straight_path_with_a_configuration_change_or_collision_is_rejected(shape: MujocoGeometry) -> None:
    routes, begin = MotionPlanner(KIND, shape), shape.poses(HOME)["flange"]
    through = (-0.249, -0.414, begin[2], *begin[3:])
    for pose in (through, (-begin[0], -begin[1], *begin[2:]), (begin[0], begin[1], -0.05, *begin[3:])):
        with pytest.raises(Refused) as refused:
            routes.plan_straight(HOME, "flange", pose, speed=0.5)
        assert refused.value.code in {"not_straight", "no_room", "out_of_reach"}
