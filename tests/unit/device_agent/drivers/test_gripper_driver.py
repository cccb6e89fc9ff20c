"""A simulated gripper stops at an object, reports it, and never claims to hold nothing."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import mujoco
import pytest

from device_agent.drivers.mujoco import GripperDriver, World, create_stepped, driver
from device_agent.drivers.mujoco.gripper_driver import _Servo
from device_agent.ports.driver import DriverError
from device_agent.ports.skills import HasControls, SkillError
from device_agent.protocol.manifests import robot_type
from tests.harness.paths import ROBOTS, UR5

if TYPE_CHECKING:
    from collections.abc import Callable

FOLDER = ROBOTS / "ur5_gripper"
TYPE = robot_type.load(FOLDER)
WIDTH_M, STROKE_M = 0.04, 0.085


@pytest.fixture(autouse=True)
def _manual_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "STALE_S", math.inf)


class Bench:
    """The arm at home with a gripper, in simulated time; a ``BehaviourContext``, whose waits pass time."""

    def __init__(self) -> None:
        made, self.world = create_stepped(TYPE, FOLDER)
        assert isinstance(made, GripperDriver)
        self.driver = made
        self.driver.connect()
        self.data: Any = self.world._data
        self.ends_at_s = math.inf
        self.carry: Callable[[], None] = lambda: None

    @property
    def ended(self) -> bool:
        return self.world.snapshot().time_s >= self.ends_at_s

    def wait(self, timeout_s: float) -> bool:
        for _ in range(round(timeout_s / 0.004)):
            self.carry()
            self.world.step(2)
        return self.ended

    def put_cube(self) -> None:
        """Put the red cube between the fingers and hold it there until the fingers do."""
        grip = self.data.site("grip").xpos.copy()

        def carry() -> None:
            if not self.driver.report("gripper")["holds"]:
                self.data.joint("red_cube").qpos[:] = [*grip, 1, 0, 0, 0]
                self.data.joint("red_cube").qvel[:] = 0

        self.carry = carry

    def set(self, value: float) -> float:
        return self.driver.set_control("gripper", value, self)

    @property
    def closed(self) -> float:
        return float(self.driver.report("gripper")["closed"])


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_the_gripper_closes_and_opens_over_its_stroke(bench: Bench) -> None:
    assert isinstance(bench.driver, HasControls)
    for value in (0.5, 1.0, 0.2, 0.0):
        assert bench.set(value) == pytest.approx(value, abs=0.01)
        assert bench.driver.report("settings") == {"gripper": pytest.approx(value, abs=0.01)}
    fingers = [bench.data.joint(f"finger_{number}").qpos[0] for number in (1, 2)]
    assert fingers == pytest.approx([0, 0], abs=5e-4)


def test_it_moves_at_the_speed_of_the_manifest(bench: Bench) -> None:
    start_s = bench.world.snapshot().time_s
    bench.set(1.0)
    assert bench.world.snapshot().time_s - start_s == pytest.approx(STROKE_M / 0.1, abs=0.2)


def test_closed_fingers_without_an_object_hold_nothing(bench: Bench) -> None:
    assert bench.set(1.0) > 0.98
    bench.wait(1.0)
    assert bench.driver.report("gripper") == {"closed": pytest.approx(1.0, abs=0.01), "holds": False}


def test_an_object_stops_the_fingers_and_is_held_by_friction(bench: Bench) -> None:
    bench.put_cube()
    closed = bench.set(1.0)
    assert closed == pytest.approx(1 - WIDTH_M / STROKE_M, abs=0.02)
    assert bench.driver.report("gripper")["holds"]
    height_m = bench.data.body("red_cube").xpos[2]
    bench.wait(2.0)
    assert bench.driver.report("gripper")["holds"]
    assert bench.data.body("red_cube").xpos[2] == pytest.approx(height_m, abs=2e-3)
    bench.carry = lambda: None
    assert bench.set(0.0) < 0.01
    assert not bench.driver.report("gripper")["holds"]
    bench.wait(0.5)
    assert bench.data.body("red_cube").xpos[2] < 0.1, "it falls"


def test_the_force_of_each_finger_is_limited(bench: Bench) -> None:
    bench.put_cube()
    bench.set(1.0)
    dofs = [int(bench.world.model.joint(f"finger_{number}").dofadr[0]) for number in (1, 2)]
    assert bench.world.snapshot().effort[dofs] == pytest.approx([60.0, 60.0])


def test_the_end_of_the_action_stops_the_fingers(bench: Bench) -> None:
    bench.ends_at_s = bench.world.snapshot().time_s + 0.3
    stopped = bench.set(1.0)
    assert 0.1 < stopped < 0.6
    bench.ends_at_s = math.inf
    bench.wait(1.0)
    assert bench.closed == pytest.approx(stopped, abs=0.05)


def test_a_stop_keeps_the_grip(bench: Bench) -> None:
    bench.put_cube()
    bench.set(1.0)
    bench.driver.halt()
    bench.wait(0.5)
    assert bench.driver.report("gripper")["holds"]
    with pytest.raises(SkillError, match="was halted"):
        bench.set(0.0)


def test_a_halt_stops_the_fingers(bench: Bench) -> None:
    def halt() -> None:
        if bench.closed > 0.3:
            bench.driver.halt()

    bench.carry = halt
    with pytest.raises(SkillError, match="was halted"):
        bench.set(1.0)
    bench.carry = lambda: None
    bench.wait(1.0)
    assert bench.closed == pytest.approx(0.33, abs=0.05)


def test_fingers_that_do_not_come_to_rest_are_an_error(bench: Bench) -> None:
    def shake() -> None:
        for number in (1, 2):
            bench.data.joint(f"finger_{number}").qpos[0] = 0.01
            bench.data.joint(f"finger_{number}").qvel[0] = 0.5

    bench.carry = shake
    with pytest.raises(SkillError, match="do not come to rest"):
        bench.set(1.0)


def test_a_reset_is_a_control_with_a_whole_number(bench: Bench) -> None:
    assert [each.name for each in bench.driver.controls] == ["gripper", "reset_objects"]
    reset = bench.driver.controls[1]
    assert (reset.upper - reset.lower) / 100 == round((reset.upper - reset.lower) / 100), (
        "a step of the console's slider"
    )
    assert bench.driver.set_control("reset_objects", 7.0, bench) == 7.0
    assert bench.driver.report("settings")["reset_objects"] == 7.0
    first = bench.driver.report("objects")
    assert {"x_m.red_cube", "yaw_rad.yellow_block"} <= set(first)
    assert bench.driver.set_control("reset_objects", 8.0, bench) == 8.0
    assert bench.driver.report("objects") != first
    with pytest.raises(SkillError, match=r"a whole number, not 7\.5"):
        bench.driver.set_control("reset_objects", 7.5, bench)


def test_a_rejected_or_late_reset_is_an_error(bench: Bench) -> None:
    bench.put_cube()
    bench.set(1.0)
    with pytest.raises(SkillError, match="is within 20 mm of 'red_cube'"):
        bench.driver.set_control("reset_objects", 7.0, bench)
    bench.ends_at_s = 0.0
    bench.world._processes = ()
    with pytest.raises(SkillError, match="has not reset the objects in time"):
        bench.driver.set_control("reset_objects", 7.0, bench)


def test_a_reset_that_the_caller_has_given_up_is_not_applied_later(bench: Bench) -> None:
    bench.driver.set_control("reset_objects", 7.0, bench)
    bench.wait(0.5)
    x_m = bench.driver.report("objects")["x_m.red_cube"]
    processes, bench.world._processes = bench.world._processes, ()
    with pytest.raises(SkillError, match="in time"):
        bench.driver.set_control("reset_objects", 8.0, bench)
    bench.world._processes = processes
    bench.wait(0.1)
    assert bench.driver.report("objects")["x_m.red_cube"] == pytest.approx(x_m, abs=1e-3)


def test_without_a_connection_there_are_no_values(bench: Bench) -> None:
    bench.driver.close()
    assert bench.driver.report("gripper") == {}
    with pytest.raises(SkillError, match="is not connected"):
        bench.set(1.0)
    with pytest.raises(SkillError, match="is not connected"):
        create_stepped(TYPE, FOLDER)[0].set_control("gripper", 1.0, bench)  # type: ignore[attr-defined]


def test_a_scene_without_objects_has_a_gripper_only(tmp_path: Path) -> None:
    for file in ("ur5_gripper.xml", "scene.xml"):
        (tmp_path / file).write_text((FOLDER / file).read_text(encoding="utf-8"), encoding="utf-8")
    made = GripperDriver(
        robot_type=TYPE, world=World(tmp_path / "scene.xml", home=TYPE.home_rad, real_time=False), device="arm"
    )
    made.connect()
    assert [each.name for each in made.controls] == ["gripper"]
    assert made.report("objects") == {}


def test_a_type_without_a_gripper_is_rejected() -> None:
    kind = robot_type.load(UR5)
    with pytest.raises(DriverError, match=r"'ur5' has no gripper; its manifest needs \[simulation\.gripper\]"):
        GripperDriver(robot_type=kind, world=World(UR5 / "scene.xml"), device="arm")


def test_an_unknown_actuator_of_the_manifest_is_an_error() -> None:
    assert TYPE.simulation is not None
    assert TYPE.simulation.gripper is not None
    gripper = msgspec.structs.replace(TYPE.simulation.gripper, actuator="hand")
    kind = msgspec.structs.replace(TYPE, simulation=msgspec.structs.replace(TYPE.simulation, gripper=gripper))
    made, _ = create_stepped(kind, FOLDER)
    with pytest.raises(DriverError, match="no actuator 'hand'; it has: shoulder_pan, "):
        made.connect()


MODEL = """
<mujoco>
  <worldbody><body><joint name="j" type="slide" axis="1 0 0"/><geom size="0.1"/><site name="s"/></body></worldbody>
  <tendon>
    <spatial name="cable"><site site="s"/><site site="t"/></spatial>
    <fixed name="t"><joint joint="j" coef="2"/></fixed>
  </tendon>
  <actuator>{actuator}</actuator>
</mujoco>
""".replace('<site name="s"/></body>', '<site name="s"/></body><site name="t"/>')


@pytest.mark.parametrize(
    "actuator",
    [
        '<position name="g" joint="j" ctrlrange="0 1"/>',
        '<position name="g" joint="j" forcerange="-1 1"/>',
        '<motor name="g" joint="j" ctrlrange="0 1" forcerange="-1 1"/>',
        '<position name="g" tendon="cable" ctrlrange="0 1" forcerange="-1 1"/>',
        '<position name="g" site="s" ctrlrange="0 1" forcerange="-1 1"/>',
    ],
)
def test_an_actuator_without_limits_or_of_another_kind_is_rejected(actuator: str) -> None:
    model: Any = mujoco.MjModel.from_xml_string(MODEL.format(actuator=actuator))
    with pytest.raises(DriverError, match="actuator 'g' is not a force-limited position servo"):
        _Servo(model, 0)


@pytest.mark.parametrize("target", ['joint="j"', 'tendon="t"'])
def test_servos_on_joints_and_fixed_tendons_are_accepted(target: str) -> None:
    actuator = f'<position name="g" {target} ctrlrange="0 0.5" forcerange="-1 1"/>'
    model: Any = mujoco.MjModel.from_xml_string(MODEL.format(actuator=actuator))
    assert _Servo(model, 0).range_m == 0.5
