"""A task is complete only if the state of the simulation shows it."""

from typing import Any

import pytest

from device_agent.protocol.manifests import tasks
from device_agent.simulation.tasks.success_monitor import SuccessMonitor
from device_agent.simulation.world import World

SCENE = """
<mujoco>
  <option timestep="0.002" gravity="0 0 -9.81"/>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 0.1"/>
    <geom name="tray" type="box" size="0.1 0.1 0.005" pos="0.5 0 0.005"/>
    <geom name="shelf" type="box" size="0.1 0.1 0.1" pos="-0.8 0 0.1"/>
    <body name="hand" pos="0 0 0.5" gravcomp="1">
      <joint name="x" type="slide" axis="1 0 0" range="-1 1"/>
      <joint name="z" type="slide" axis="0 0 1" range="-1 1"/>
      <geom name="palm" type="box" size="0.02 0.02 0.005" mass="1"/>
    </body>
    <body name="cube" pos="0 0 0.0199">
      <freejoint name="cube"/>
      <geom name="cube" type="box" size="0.02 0.02 0.02" mass="0.1"/>
    </body>
    <body name="lid" pos="0.9 0 0.1">
      <joint name="lid" type="slide" axis="1 0 0" range="0 0.3" damping="1" frictionloss="1"/>
      <geom name="lid" type="box" size="0.02 0.02 0.02" mass="0.2"/>
    </body>
  </worldbody>
  <actuator>
    <position name="x" joint="x" kp="2000" kv="200" ctrlrange="-1 1"/>
    <position name="z" joint="z" kp="2000" kv="200" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""
TASKS = tasks.parse(
    """
    [[objects]]
    name = "cube"
    lower_m = [0.0, 0.0]
    upper_m = [0.0, 0.0]
    mass_kg = [0.1, 0.1]
    friction = [1.0, 1.0]

    [[regions]]
    name = "tray"
    lower_m = [0.4, -0.1, 0.01]
    upper_m = [0.6, 0.1, 0.05]

    [[joints]]
    name = "lid"
    position = [0.0, 0.0]
    friction = [1.0, 1.0]
    damping = [1.0, 1.0]

    [[regions]]
    name = "on_lid"
    part = "lid"
    lower_m = [-0.02, -0.02, 0.015]
    upper_m = [0.02, 0.02, 0.025]

    [[tasks]]
    name = "open"
    label = "Open"
    description = "Open the lid."
    movement = "open"
    time_limit_s = 10.0

    [tasks.success]
    joint = "lid"
    at_least = 0.1
    rest_s = 0.5

    [[tasks]]
    name = "hold"
    label = "Hold"
    description = "Hold the cube."
    movement = "hold"
    time_limit_s = 10.0

    [tasks.success]
    object = "cube"
    lifted_m = 0.1
    rest_s = 0.5

    [[tasks]]
    name = "stack"
    label = "Stack"
    description = "Put the cube on the lid."
    movement = "stack"
    time_limit_s = 10.0

    [tasks.success]
    object = "cube"
    region = "on_lid"
    point_m = [0.0, 0.0, -0.02]
    lifted_m = 0.05
    rest_s = 0.5

    [[tasks]]
    name = "place"
    label = "Place"
    description = "Place the cube."
    movement = "place"
    time_limit_s = 10.0

    [tasks.success]
    object = "cube"
    region = "tray"
    rest_s = 1.0
    lifted_m = 0.05
    """
)
ON_TRAY_M, ON_FLOOR_M = 0.0299, 0.0199
PALM_M = 0.025
"""Height of the cube's center over that of the palm that carries it."""


class Bench:
    """A palm on two slides, a cube and a tray, stepped manually."""

    def __init__(self, tmp_path: Any, task: str = "place") -> None:
        path = tmp_path / "scene.xml"
        path.write_text(SCENE, encoding="utf-8")
        self.world = World(path, real_time=False)
        self.world.open()
        self.data: Any = self.world._data
        self.monitor = SuccessMonitor(TASKS, task)
        self.world.add(self.monitor)
        self.run(0.1)

    def run(self, duration_s: float) -> None:
        self.world.step(round(duration_s / 0.002))

    def put(self, x_m: float, z_m: float) -> None:
        """Put the cube somewhere, at rest."""
        self.data.joint("cube").qpos[:] = [x_m, 0, z_m, 1, 0, 0, 0]
        self.data.joint("cube").qvel[:] = 0

    def palm(self, x_m: float, z_m: float) -> None:
        """Put the palm and its servo somewhere; the model's palm starts at a height of 0.5 m."""
        self.data.joint("x").qpos[0], self.data.joint("z").qpos[0] = x_m, z_m - 0.5
        self.data.ctrl[:] = x_m, z_m - 0.5

    def lift(self, x_m: float = 0.0, z_m: float = 0.2) -> None:
        """Let the palm carry the cube."""
        self.palm(x_m, z_m)
        self.put(x_m, z_m + PALM_M - 1e-4)
        self.run(0.1)
        self.palm(x_m, z_m)

    def withdraw(self) -> None:
        self.palm(-0.5, 0.5)


@pytest.fixture
def bench(tmp_path: Any) -> Bench:
    return Bench(tmp_path)


def test_a_lifted_object_at_rest_in_the_region_completes_the_task(bench: Bench) -> None:
    bench.lift()
    assert bench.monitor.lifted
    bench.withdraw()
    bench.put(0.5, ON_TRAY_M)
    bench.run(0.8)
    assert not bench.monitor.met
    bench.run(0.5)
    assert bench.monitor.met


def test_an_object_at_rest_for_less_than_the_time_does_not(bench: Bench) -> None:
    bench.lift()
    bench.withdraw()
    bench.put(0.5, ON_TRAY_M)
    while bench.monitor.rest_s < 0.9:
        bench.run(0.004)
    assert not bench.monitor.met
    bench.data.joint("cube").qvel[0] = 0.05
    bench.run(0.1)
    assert bench.monitor.rest_s < 0.1
    bench.run(0.9)
    assert not bench.monitor.met


def test_an_object_that_was_pushed_into_the_region_does_not(bench: Bench) -> None:
    bench.put(0.3, ON_FLOOR_M)
    bench.palm(0.25, 0.02)
    bench.run(0.05)  # the palm touches the cube, which stands on the floor
    bench.withdraw()
    bench.put(0.5, ON_TRAY_M)
    bench.run(2.0)
    assert not bench.monitor.lifted
    assert not bench.monitor.met


def test_an_object_that_the_robot_only_touched_on_a_shelf_is_not_lifted(bench: Bench) -> None:
    bench.put(-0.8, 0.2 + ON_FLOOR_M)
    bench.palm(-0.8 + 0.0398, 0.22)
    bench.run(0.2)
    assert not bench.monitor.lifted
    bench.lift(-0.8, 0.3)
    assert bench.monitor.lifted


def test_an_object_at_rest_beside_the_region_does_not(bench: Bench) -> None:
    bench.lift()
    bench.withdraw()
    bench.put(0.3, ON_FLOOR_M)
    bench.run(2.0)
    assert bench.monitor.lifted
    assert not bench.monitor.met


def test_an_object_that_the_robot_still_touches_does_not(bench: Bench) -> None:
    bench.lift()
    bench.put(0.5, ON_TRAY_M)
    bench.palm(0.5, ON_TRAY_M + PALM_M - 1e-3)  # rests on the cube
    bench.run(2.0)
    contacts = {tuple(sorted(pair)) for pair in bench.data.contact.geom[: bench.data.ncon].tolist()}
    palm, cube = (int(bench.world.model.geom(name).id) for name in ("palm", "cube"))
    assert tuple(sorted((palm, cube))) in contacts
    assert not bench.monitor.met


def test_an_object_that_is_held_above_the_region_does_not(bench: Bench) -> None:
    bench.lift(0.5, 0.1)
    assert bench.monitor.lifted
    bench.run(2.0)
    assert not bench.monitor.met
    bench.lift(0.5, 0.02)  # inside of the region, but on the palm
    bench.run(2.0)
    assert not bench.monitor.met


def test_an_empty_hand_does_not(bench: Bench) -> None:
    bench.palm(0.5, 0.2)
    bench.run(0.5)
    bench.withdraw()
    bench.run(2.0)
    assert not bench.monitor.met


def test_an_object_that_falls_from_outside_does_not_rest_while_it_moves(bench: Bench) -> None:
    bench.lift()
    bench.withdraw()
    bench.put(0.5, 0.04)
    bench.run(0.02)
    assert bench.monitor.rest_s == 0.0


def test_a_new_trial_forgets_the_last_one(bench: Bench) -> None:
    bench.lift()
    bench.withdraw()
    bench.put(0.5, ON_TRAY_M)
    bench.run(1.5)
    assert bench.monitor.met
    bench.monitor.restart()
    bench.run(2.0)
    assert not bench.monitor.met


# ------------------------------------------------------------ other conditions


def push_lid(bench: Bench, place_m: float) -> None:
    """Move the lid while the palm touches it."""
    bench.data.joint("lid").qpos[0], bench.data.joint("lid").qvel[0] = place_m, 0.0
    bench.palm(0.9 + place_m - 0.0398, 0.1)
    bench.run(0.05)


def test_a_joint_that_a_robot_has_moved_and_released_completes_the_task(tmp_path: Any) -> None:
    bench = Bench(tmp_path, "open")
    push_lid(bench, 0.05)
    assert bench.monitor.shortfall == "the robot did not move the joint far enough"
    push_lid(bench, 0.15)
    assert bench.monitor.lifted
    assert bench.monitor.shortfall == "the joint did not stay at its position without contact to the robot"
    bench.palm(0.9 + float(bench.data.joint("lid").qpos[0]) - 0.0398, 0.1)
    bench.withdraw()
    bench.run(0.7)
    assert bench.monitor.met
    assert bench.monitor.shortfall == ""


def test_a_joint_that_moved_without_a_robot_does_not(tmp_path: Any) -> None:
    bench = Bench(tmp_path, "open")
    bench.data.joint("lid").qpos[0] = 0.15
    bench.run(1.0)
    assert not bench.monitor.lifted
    assert not bench.monitor.met


def test_a_joint_that_closes_again_does_not(tmp_path: Any) -> None:
    bench = Bench(tmp_path, "open")
    push_lid(bench, 0.15)
    bench.withdraw()
    bench.data.joint("lid").qpos[0] = 0.05
    bench.run(1.0)
    assert bench.monitor.lifted
    assert not bench.monitor.met


def test_an_object_that_a_robot_holds_for_the_time_completes_the_task(tmp_path: Any) -> None:
    bench = Bench(tmp_path, "hold")
    bench.lift(0.0, 0.05)
    bench.run(1.0)
    assert bench.monitor.shortfall == "the robot did not lift the object"
    bench.lift(0.0, 0.2)
    assert bench.monitor.shortfall == "the robot did not hold the object for long enough"
    bench.run(0.6)
    assert bench.monitor.met


def test_an_object_that_lies_high_or_falls_does_not(tmp_path: Any) -> None:
    bench = Bench(tmp_path, "hold")
    bench.withdraw()
    bench.put(-0.8, 0.2 + ON_FLOOR_M)  # on the shelf
    bench.run(1.0)
    assert not bench.monitor.met
    bench.lift(0.0, 0.2)
    bench.withdraw()
    bench.run(1.0)
    assert bench.monitor.lifted
    assert not bench.monitor.met


def test_a_region_moves_with_its_part_and_a_point_of_the_object_must_be_inside(tmp_path: Any) -> None:
    bench = Bench(tmp_path, "stack")
    bench.lift()
    bench.withdraw()
    bench.put(0.9, 0.1399)
    bench.run(1.0)
    assert bench.monitor.met
    bench.data.joint("lid").qpos[0], bench.data.joint("lid").qvel[0] = 0.2, 0.0
    bench.put(1.1, 0.1399)
    bench.run(1.0)
    assert bench.monitor.met
    bench.put(0.9, 0.0199)  # where the region was
    bench.run(1.0)
    assert not bench.monitor.met


def test_nothing_is_complete_before_the_first_step() -> None:
    monitor = SuccessMonitor(TASKS, "hold")
    assert (monitor.met, monitor.lifted, monitor.shortfall) == (False, False, "nothing was observed")
