"""The observation of a task for an agent: verdicts only from the scene of the robot's type, and only while it runs."""

import math
from pathlib import Path

import pytest

from device_agent.drivers.mujoco import MujocoDriver, World, create_stepped, driver
from device_agent.ports.driver import DriverError
from device_agent.ports.skills import ObservesTasks
from device_agent.protocol import TrialCause
from device_agent.protocol.manifests import robot_type, tasks
from device_agent.simulation.tasks import task_observer
from device_agent.simulation.tasks.scene_objects import objects_of
from tests.harness.paths import ROBOTS

FOLDER = ROBOTS / "ur5_gripper"
TASK = "red_cube_in_green_tray"
TRAY_M = (-0.5, 0.25)


@pytest.fixture(autouse=True)
def _manual_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "STALE_S", math.inf)


class Bench:
    """The arm at home, in simulated time."""

    def __init__(self) -> None:
        self.driver: MujocoDriver
        self.driver, self.world = create_stepped(robot_type.load(FOLDER), FOLDER)
        self.driver.connect()
        manifest = tasks.load(self.world.scene)
        assert manifest is not None
        self.manifest = manifest
        self.monitor = self.driver.observe_task(manifest, TASK)

    def move_cube(self, x_m: float, y_m: float, z_m: float) -> None:
        joint = self.world.model.jnt_qposadr[self.world.model.body("red_cube").jntadr[0]]
        self.world._data.qpos[joint : joint + 3] = x_m, y_m, z_m

    def run(self, duration_s: float) -> None:
        self.world.step(round(duration_s / 0.002))


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_nothing_is_met_before_the_first_step(bench: Bench) -> None:
    assert isinstance(bench.driver, ObservesTasks)
    state = bench.monitor.state()
    assert (state.met, state.failure, state.time_s) == (False, TrialCause.NOT_MET, bench.world.snapshot().time_s)


def test_the_state_follows_the_simulation(bench: Bench) -> None:
    bench.run(0.5)
    state = bench.monitor.state()
    assert (state.met, state.failure) == (False, TrialCause.NOT_MET)
    assert state.detail == "the robot did not lift the object"
    assert state.time_s == pytest.approx(bench.world.snapshot().time_s, abs=0.01)


def test_a_cube_that_appears_in_the_tray_was_not_lifted_by_the_robot(bench: Bench) -> None:
    bench.run(0.2)
    bench.move_cube(*TRAY_M, 0.05)
    bench.run(3.0)
    assert not bench.monitor.state().met


def test_a_lifted_cube_in_the_tray_completes_the_task_until_the_restart(bench: Bench) -> None:
    bench.run(0.2)
    assert bench.monitor._monitor._condition is not None
    bench.monitor._monitor._condition.reached = True
    bench.move_cube(-0.4, -0.2, 0.05)
    bench.run(0.5)
    assert bench.monitor.state().failure is TrialCause.INCOMPLETE
    bench.move_cube(*TRAY_M, 0.05)
    bench.run(3.0)
    assert bench.monitor.state().met
    bench.monitor.restart()
    assert not bench.monitor.state().met
    bench.run(3.0)
    assert not bench.monitor.state().met, "the cube has not moved since the restart"


def test_a_closed_monitor_observes_no_longer(bench: Bench) -> None:
    other = bench.driver.observe_task(bench.manifest, TASK)
    bench.run(0.1)
    bench.monitor.close()
    before_s = bench.monitor.state().time_s
    bench.run(0.1)
    assert bench.monitor.state().time_s == before_s
    assert other.state().time_s > before_s


def test_a_failed_simulation_is_not_observed(bench: Bench) -> None:
    bench.world._data.qpos[0] = math.nan
    with pytest.raises(DriverError, match="unstable"):
        bench.run(0.1)
    with pytest.raises(DriverError, match="unstable"):
        bench.monitor.state()


def test_a_scene_without_the_objects_of_the_task_is_rejected(bench: Bench) -> None:
    world = World(ROBOTS / "ur5" / "scene.xml", real_time=False)
    with pytest.raises(DriverError, match="does not have the objects of task"):
        task_observer.observe(world, bench.manifest, TASK)


def test_a_manifest_without_objects_adds_nothing_to_the_scene(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text("<mujoco/>", encoding="utf-8")
    (tmp_path / "tasks.toml").write_text("gap_m = 0.1\n", encoding="utf-8")
    assert objects_of(World(tmp_path / "scene.xml", real_time=False)) is None
