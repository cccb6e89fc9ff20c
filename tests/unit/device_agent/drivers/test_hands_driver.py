"""The hands of the simulated NAO touch objects; a scene with objects adds their reset and their poses."""

import math
from typing import Any

import mujoco
import pytest

from device_agent.drivers.mujoco import BipedDriver, HandsDriver, create, create_stepped, driver
from device_agent.ports.skills import HasControls, SkillError
from device_agent.protocol.manifests import robot_type
from tests.harness.paths import ROBOTS

pytestmark = pytest.mark.slow
FOLDER = ROBOTS / "nao"
TYPE = robot_type.load(FOLDER)


@pytest.fixture(autouse=True)
def _manual_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "STALE_S", math.inf)


class Bench:
    """NAO before the rack in simulated time; a ``BehaviourContext``, whose waits pass time."""

    ended = False

    def __init__(self) -> None:
        made, self.world = create_stepped(TYPE, FOLDER, scene="rack.xml")
        assert isinstance(made, HandsDriver)
        self.driver = made
        self.driver.connect()

    def wait(self, timeout_s: float) -> bool:
        self.world.step(round(timeout_s / 0.002))
        return False


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_the_scene_with_the_rack_adds_a_reset_and_poses(bench: Bench) -> None:
    assert isinstance(bench.driver, HasControls)
    assert [each.name for each in bench.driver.controls] == ["reset_objects"]
    assert bench.driver.report("settings") == {}
    assert bench.driver.set_control("reset_objects", 3.0, bench) == 3.0
    assert bench.driver.report("settings") == {"reset_objects": 3.0}
    bench.wait(0.2)
    values = bench.driver.report("objects")
    torso, stick = (
        bench.world.snapshot().body_position_m[bench.world.model.body(name).id] for name in ("torso", "stick")
    )
    assert [values[f"{axis}_m.stick"] for axis in "xyz"] == pytest.approx((stick - torso).tolist(), abs=2e-3)
    assert values["width_m.stick"] == pytest.approx(0.16, rel=0.06)
    assert set(bench.driver.report("odometry")) >= {"x_m", "y_m", "yaw_rad"}


def test_a_reset_is_rejected_near_the_hand_and_without_a_connection(bench: Bench) -> None:
    data: Any = bench.world._data
    data.joint("stick").qpos[:3] = data.site("RArm").xpos
    mujoco.mj_kinematics(bench.world.model, data)
    with pytest.raises(SkillError, match="is within 20 mm of 'stick'"):
        bench.driver.set_control("reset_objects", 3.0, bench)
    bench.driver.halt()
    with pytest.raises(SkillError, match="was halted"):
        bench.driver.set_control("reset_objects", 3.0, bench)
    bench.driver.close()
    assert bench.driver.report("objects") == {}
    with pytest.raises(SkillError, match="is not connected"):
        bench.driver.set_control("reset_objects", 3.0, bench)


def test_the_usual_scene_has_no_objects() -> None:
    made, _ = create_stepped(TYPE, FOLDER)
    assert type(made) is BipedDriver
    assert not isinstance(made, HasControls)


def test_the_option_scene_selects_the_rack() -> None:
    assert isinstance(create(TYPE, FOLDER, {"scene": "rack.xml"}, "nao"), HandsDriver)


def test_fingers_touch_objects_only(bench: Bench) -> None:
    model = bench.world.model
    fingers = [geom for geom in range(model.ngeom) if model.geom_contype[geom] == 2]
    assert len(fingers) == 10, "four shapes of the fingers and one of the thumb of each hand"
    stick = model.geom("stick").id
    for finger in fingers:
        partners = [geom for geom in range(model.ngeom) if 2 & model.geom_conaffinity[geom]]
        assert partners == [stick], model.body(model.geom_bodyid[finger]).name
        assert not model.geom_conaffinity[finger]


@pytest.mark.parametrize("side", ["L", "R"])
def test_the_hands_have_the_names_and_range_of_naoqi(side: str) -> None:
    (hand,) = (joint for joint in TYPE.joints if joint.name == f"{side}Hand")
    assert (hand.lower_rad, hand.upper_rad) == (0.0, 1.0)
    assert TYPE.simulation is not None
    assert hand.name in TYPE.simulation.grips
