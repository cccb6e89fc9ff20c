"""The planner process: equal results, cancellation, failures, and no orphans."""

import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from device_agent import geometry
from device_agent.geometry.joint_bounds import JointBounds
from device_agent.geometry.mujoco_geometry import MujocoGeometry
from device_agent.ports.geometry import GeometryError, PlannerLostError
from device_agent.protocol import MoveJoints, StopLatch
from device_agent.protocol.manifests import robot_type
from device_agent.runtime.actions.device_context import DeviceContext
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.control.goals import GoalResult
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.joint_couplings import Couplings
from device_agent.runtime.planning.motion_planner import MotionPlanner
from device_agent.runtime.readings import ReadingCache
from tests.harness.paths import ROBOTS, ROOT, UR5

pytestmark = pytest.mark.slow
NAO = ROBOTS / "nao"
KIND = robot_type.load(UR5)
HOME = [KIND.home_rad[joint.name] for joint in KIND.joints]
BEYOND = [1.6, *HOME[1:]]
TIMEOUT_S = 60.0
WALL = '<geom type="box" size="0.9 0.02 1.5" pos="{} {} 1.5" euler="0 0 {}"/>'


@pytest.fixture(scope="module")
def divided(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The arm's scene divided by two walls: planning across always times out."""
    folder = tmp_path_factory.mktemp("ur5")
    (folder / "ur5.xml").write_bytes((UR5 / "ur5.xml").read_bytes())
    angle = math.atan2(-0.414, -0.249)
    walls = [WALL.format(1.1 * math.cos(at), 1.1 * math.sin(at), at) for at in (angle, angle + math.pi)]
    text = (UR5 / KIND.scene).read_text(encoding="utf-8").replace("<worldbody>", f"<worldbody>{''.join(walls)}", 1)
    (folder / KIND.scene).write_text(text, encoding="utf-8")
    return folder / KIND.scene


@pytest.fixture
def shape(divided: Path) -> Iterator[MujocoGeometry]:
    shape = MujocoGeometry(KIND, divided)
    yield shape
    shape._planner_process._process.stop()


def until(happened: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + TIMEOUT_S
    while not happened():
        assert time.monotonic() < deadline_s, "timeout"
        time.sleep(0.01)


def pid_of(shape: MujocoGeometry) -> int:
    running = shape._planner_process._process.running
    return 0 if running is None else running.pid


def stat(pid: int) -> list[str]:
    """Fields of ``/proc/<pid>/stat`` from the state on; a zombie's if there is no such process."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    except OSError:
        return ["Z"]


def alive(pid: int) -> bool:
    return stat(pid)[0] != "Z"


def test_the_process_plans_the_same_path() -> None:
    shape = MujocoGeometry(KIND, UR5 / KIND.scene)
    low = shape.solve("flange", (*shape.poses(HOME)["flange"][:2], 0.1, *shape.poses(HOME)["flange"][3:]), HOME)
    goal = [low[0] + 2.5, *low[1:]]
    planned = shape.plan(low, goal, seed=4)
    assert planned == shape.plan_here(low, goal, seed=4, within_s=5.0)
    first = pid_of(shape)
    shape.plan(goal, low, seed=4)
    assert pid_of(shape) == first, "the process still runs"
    del shape
    until(lambda: not alive(first))


def test_a_planning_failure_is_reported(shape: MujocoGeometry) -> None:
    with pytest.raises(GeometryError, match="found no path in 0 s"):
        shape.plan(HOME, BEYOND, within_s=0.2)


def test_cancelling_kills_the_process(shape: MujocoGeometry) -> None:
    shape.plan(HOME, HOME)
    pid, enough = pid_of(shape), threading.Event()
    threading.Timer(0.3, enough.set).start()
    with pytest.raises(GeometryError, match="cancelled"):
        shape.plan(HOME, BEYOND, within_s=TIMEOUT_S, ended=enough.is_set)
    assert not alive(pid)


@pytest.fixture
def controller(shape: MujocoGeometry) -> Controller:
    controller = Controller(KIND, LeaseGate(), geometry=shape)
    controller.start_at(HOME)
    return controller


def cross_while(shape: MujocoGeometry, controller: Controller, event: Callable[[], object]) -> Refused:
    """Request an impossible motion, cause the event during planning, and return the rejection."""
    body = DeviceContext(
        robot_type=KIND,
        controller=controller,
        observe=lambda: None,
        geometry=shape,
        skills=None,
        readings=ReadingCache(space="s", agent="a", own=[]),
    )
    robot = RobotApi(body)
    robot.reserve(1, lambda _: robot.end())

    def disturb() -> None:
        until(lambda: pid_of(shape) > 0)
        event()

    with ThreadPoolExecutor() as pool:
        pool.submit(disturb)
        with pytest.raises(Refused) as refused:
            robot.execute(MoveJoints(position_rad={KIND.joints[0].name: BEYOND[0]}, speed=0.5, plan=True))
    return refused.value


def test_a_killed_planner_fails_the_action(shape: MujocoGeometry, controller: Controller) -> None:
    refused = cross_while(shape, controller, lambda: os.kill(pid_of(shape), signal.SIGKILL))
    assert refused.code == "planner_lost"
    assert "SIGKILL" in refused.message
    assert not controller.moving
    assert controller.commanded_rad == HOME
    assert shape.plan(HOME, HOME), "a new process starts"


def test_a_hanging_planner_times_out(shape: MujocoGeometry, monkeypatch: pytest.MonkeyPatch) -> None:
    shape.plan(HOME, HOME)
    pid = pid_of(shape)
    os.kill(pid, signal.SIGSTOP)
    monkeypatch.setattr("device_agent.geometry.planner_process._STARTUP_S", 0.2)
    with pytest.raises(PlannerLostError, match="does not respond"):
        shape.plan(HOME, BEYOND, within_s=0.1)
    assert not alive(pid)


def test_stop_cancels_planning(shape: MujocoGeometry, controller: Controller) -> None:
    latch = StopLatch(caller="ann", reason="", at_ms=0)
    assert "cancelled" in cross_while(shape, controller, lambda: controller.stop(latch)).message
    assert pid_of(shape) == 0


def test_an_invalid_scene_and_a_failed_start_are_reported(
    shape: MujocoGeometry, monkeypatch: pytest.MonkeyPatch
) -> None:
    process = shape._planner_process
    monkeypatch.setattr(process, "_scene", type(process._scene)(robot_type=KIND, scene="/nowhere/scene.xml"))
    with pytest.raises(GeometryError, match=r"/nowhere/scene\.xml"):
        shape.plan(HOME, HOME)
    process._process.stop()
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.raises(PlannerLostError, match="does not start"):
        shape.plan(HOME, HOME)


AGENT = """
import sys, threading
from pathlib import Path
from device_agent.geometry.mujoco_geometry import MujocoGeometry
from device_agent.protocol.manifests import robot_type
from tests.unit.device_agent.geometry import test_planner_process as t
shape = MujocoGeometry(t.KIND, Path(sys.argv[1]))
shape.plan(t.HOME, t.HOME)
print(t.pid_of(shape), flush=True)
shape.plan(t.HOME, t.BEYOND, within_s=600.0)
"""


def test_the_process_exits_when_the_agent_is_killed(divided: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", AGENT, str(divided)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    ) as agent:
        assert agent.stdout is not None
        pid = int(agent.stdout.readline())
        ticks = int(stat(pid)[11])
        until(lambda: int(stat(pid)[11]) > ticks + 10)  # CPU time: it plans
        agent.kill()
    until(lambda: not alive(pid))


# ------------------------------------------------------------ coupled joints


def test_planned_paths_respect_joint_couplings() -> None:
    kind = robot_type.load(NAO)
    shape = geometry.load(kind, NAO)
    assert shape is not None
    names = [joint.name for joint in kind.joints]
    couplings = Couplings(kind)
    controller = Controller(kind, LeaseGate(), geometry=shape)
    controller.start_at([kind.home_rad[name] for name in names])
    reservation = controller.reserve(epoch=1, on_revoked=lambda _: None)
    now_s = 0.0
    for target in ({"HeadPitch": 0.45}, {"HeadYaw": 2.05, "HeadPitch": 0.25, "LHipYawPitch": -0.1}):
        start, goal = controller.commanded_rad, controller.resolve_target(reservation, target)
        path = MotionPlanner(kind, shape).plan(start, goal, speed=1.0, ended=lambda: False)
        motion = controller.start_trajectory(reservation, path)
        for _ in range(round(path.duration_s / (kind.period_ms / 1000)) + 50):
            now_s += kind.period_ms / 1000
            tick = controller.update(now_s)
            assert couplings.describe_violation(np.array([tick.position_rad])) == ""
        assert motion.result is GoalResult.REACHED, motion.why
        assert controller.commanded_rad == pytest.approx(goal, abs=1e-4)
    assert couplings.describe_violation(np.linspace(start, goal, 50)) != "", "the straight path violates them"
    assert goal[names.index("RHipYawPitch")] == pytest.approx(-0.1)


def test_position_dependent_limits_are_checked_between_table_rows() -> None:
    kind = robot_type.load(NAO)
    bounds, couplings = JointBounds(kind), Couplings(kind)
    names = [joint.name for joint in kind.joints]
    home = np.array([kind.home_rad[name] for name in names])
    head = [names.index("HeadYaw"), names.index("HeadPitch")]
    random = np.random.default_rng(3)
    admitted = 0
    for _ in range(400):
        start, end = home.copy(), home.copy()
        start[head], end[head] = random.uniform((-2, -0.5), (2, 0.4), (2, 2))
        admits = bounds.admits(start, end, np.zeros(1))
        assert admits == (couplings.describe_violation(np.linspace(start, end, 2000)) == "")
        admitted += admits
    assert 50 < admitted < 350
    assert bounds.clearance(home, home)[0] == pytest.approx(0.03)
