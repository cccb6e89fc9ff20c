"""Motion planning around obstacles and on straight lines."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import mujoco
import numpy as np
import pytest

from device_agent.geometry.mujoco_geometry import MujocoGeometry
from device_agent.ports.geometry import GeometryError, PlannerLostError, never
from device_agent.protocol.manifests import robot_type
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.control.goals import GoalResult
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning import motion_planner
from device_agent.runtime.planning.motion_planner import MotionPlanner
from tests.harness.paths import UR5

KIND = robot_type.load(UR5)
HOME = [KIND.home_rad[joint.name] for joint in KIND.joints]
BEYOND = [1.6, *HOME[1:]]
PERIOD_S = KIND.period_ms / 1000
POST = '<geom name="post" type="cylinder" size="0.04 0.35" pos="-0.249 -0.414 0.35"/>'


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The table with a post on it, half way between the home position and the goal."""
    folder = tmp_path_factory.mktemp("ur5")
    (folder / "ur5.xml").write_bytes((UR5 / "ur5.xml").read_bytes())
    text = (UR5 / KIND.scene).read_text().replace("<worldbody>", f"<worldbody>{POST}", 1)
    (folder / KIND.scene).write_text(text)
    return folder / KIND.scene


@pytest.fixture(scope="module")
def shape(scene: Path) -> MujocoGeometry:
    return MujocoGeometry(KIND, scene)


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Searches may take long on a busy machine."""
    monkeypatch.setattr(motion_planner, "_SEARCH_TIMEOUT_S", 120.0)


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
        position: list[float] = self.data.site("flange").xpos.tolist()
        return position


def execute(scene: Path, shape: MujocoGeometry, seed: int) -> float:
    """Plan with this seed and follow the plan; returns the position error of the flange [m]."""
    physics = Physics(scene, shape)
    trajectory = MotionPlanner(KIND, shape, seed=seed).plan(HOME, BEYOND, speed=1.0, ended=never)
    goal = physics.controller.start_trajectory(physics.reservation, trajectory)
    physics.run(trajectory.duration_s + 1.5)
    assert goal.result is GoalResult.REACHED, goal.why
    assert goal.limited == ()
    assert physics.touched == 0
    return math.dist(physics.flange_m(), shape.poses(BEYOND)["flange"][:3])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_plan_avoids_the_post_and_reaches_the_goal(scene: Path, shape: MujocoGeometry, seed: int) -> None:
    obstacle = shape.sweep([HOME, BEYOND]).clearance
    assert obstacle is not None
    assert "post" in obstacle.text, "the straight path collides"
    assert execute(scene, shape, seed) <= 0.001


@pytest.mark.long
def test_planning_succeeds_with_twenty_seeds(scene: Path, shape: MujocoGeometry) -> None:
    assert max(execute(scene, shape, 100 + seed) for seed in range(20)) <= 0.001


@pytest.mark.slow
def test_a_straight_path_is_straight_in_simulation(scene: Path, shape: MujocoGeometry) -> None:
    physics = Physics(scene, shape)
    begin = shape.poses(HOME)["flange"]
    pose = (begin[0], begin[1] + 0.25, begin[2] - 0.05, *begin[3:])
    line = np.subtract(pose[:3], begin[:3])

    def error_m(position_m: Sequence[float]) -> float:
        """Distance from the line."""
        offset = np.subtract(position_m, begin[:3])
        return float(np.linalg.norm(offset - line * (offset @ line) / (line @ line)))

    trajectory = MotionPlanner(KIND, shape).plan_straight(HOME, "flange", pose, speed=0.5)
    physics.controller.start_trajectory(physics.reservation, trajectory)
    for _ in range(round(trajectory.duration_s / PERIOD_S) + 100):
        physics.run(PERIOD_S)
        assert error_m(physics.flange_m()) <= 0.004
    assert math.dist(physics.flange_m(), pose[:3]) <= 0.001
    for position_rad in trajectory.position_rad[::5]:
        assert error_m(shape.poses(position_rad.tolist())["flange"][:3]) <= 0.0005


@pytest.mark.slow
@pytest.mark.parametrize(
    ("goal_rad", "options", "message"),
    [
        ([0.8, *HOME[1:]], {}, "the goal is not clear: clearance: post"),
        (BEYOND, {"within_s": 0.0}, "found no path in 0 s"),
        (BEYOND, {"ended": lambda: True}, "cancelled"),
    ],
)
def test_a_search_without_a_result_is_an_error(
    shape: MujocoGeometry, goal_rad: list[float], options: dict[str, Any], message: str
) -> None:
    with pytest.raises(GeometryError, match=message):
        shape.plan(HOME, goal_rad, **options)


def test_a_lost_planner_is_reported(shape: MujocoGeometry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shape, "plan", mock.Mock(side_effect=PlannerLostError("the planner has ended; try again")))
    with pytest.raises(Refused, match="try again") as refused:
        MotionPlanner(KIND, shape).plan(HOME, BEYOND, speed=1.0, ended=never)
    assert refused.value.code == "planner_lost"


def test_a_plan_depends_on_the_seed_and_passes_the_clearance_check(shape: MujocoGeometry) -> None:
    path = shape.plan(HOME, BEYOND, seed=7)
    assert path == shape.plan(HOME, BEYOND, seed=7)
    assert path != shape.plan(HOME, BEYOND, seed=8)
    assert (path[0], path[-1]) == (tuple(HOME), tuple(BEYOND))
    assert shape.sweep(path).clearance is None


@pytest.mark.slow
def test_a_straight_path_with_a_configuration_change_or_collision_is_rejected(shape: MujocoGeometry) -> None:
    planner, begin = MotionPlanner(KIND, shape), shape.poses(HOME)["flange"]
    through = (-0.249, -0.414, begin[2], *begin[3:])
    for pose in (through, (-begin[0], -begin[1], *begin[2:]), (begin[0], begin[1], -0.05, *begin[3:])):
        with pytest.raises(Refused) as refused:
            planner.plan_straight(HOME, "flange", pose, speed=0.5)
        assert refused.value.code in {"not_straight", "no_room", "out_of_reach"}
