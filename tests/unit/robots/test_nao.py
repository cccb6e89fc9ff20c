"""NAO against its published figures, and in balance: it stands, sits, walks, and does not fall."""

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import mujoco
import numpy as np
import pytest

from device_agent import geometry
from device_agent.drivers.mujoco import BipedDriver, MujocoDriver, World, create
from device_agent.ports.driver import REST, DriverError, Twist
from device_agent.protocol import StopLatch
from device_agent.protocol.manifests import robot_type
from tests.harness.paths import ROBOTS
from tests.unit.robots.balance import Walking

FOLDER = ROBOTS / "nao"
TYPE = robot_type.load(FOLDER)
FACTS: dict[str, Any] = json.loads((Path(__file__).parent / "nao_v5.json").read_text(encoding="utf-8"))
FINGERS = {"l_wrist": "LFingers", "r_wrist": "RFingers"}
"""The description has the fingers' mass in the wrist's; here they are bodies of their own."""
LEGS = [joint.name for joint in TYPE.joints if joint.name[1:].startswith(("Hip", "Knee", "Ankle"))]
FORWARD = Twist(forward_m_s=0.1)
UPRIGHT = 0.95
"""Cosine of the torso's tilt: 18 degrees, more than any posture leans."""


@pytest.fixture(scope="module")
def model() -> Any:
    return mujoco.MjModel.from_xml_path(str(FOLDER / TYPE.model))


# ---------------------------------------------------------------- figures


def test_joints_are_those_of_the_description(model: Any) -> None:
    assert [joint.name for joint in TYPE.joints] == [fact["name"] for fact in FACTS["joints"]]
    assert len(TYPE.joints) == 26
    for joint, fact in zip(TYPE.joints, FACTS["joints"], strict=True):
        assert (joint.lower_rad, joint.upper_rad) == (fact["lo"], fact["hi"])
        assert joint.max_velocity_rad_s == fact["vel"]
        assert joint.max_effort_nm == fact["torque_Nm"]
        in_model, body = model.joint(joint.name), model.body(model.joint(joint.name).bodyid[0])
        assert in_model.range == pytest.approx((fact["lo"], fact["hi"]))
        assert body.pos == pytest.approx(fact["offset_m"], abs=1e-6)
        assert not in_model.pos.any(), "a body stands where its joint turns"
        if not joint.name.endswith("Hand"):  # README.md: fingers are simpler here
            assert in_model.axis == pytest.approx(np.array(fact["axis"]) / np.linalg.norm(fact["axis"]), abs=1e-6)


def test_masses_are_those_of_the_description(model: Any) -> None:
    for name, mass_kg in FACTS["masses_kg"].items():
        parts = [name, FINGERS[name]] if name in FINGERS else [name]
        assert sum(model.body(part).mass[0] for part in parts) == pytest.approx(mass_kg, abs=1e-9)
    assert model.body_subtreemass[model.body("torso").id] == pytest.approx(sum(FACTS["masses_kg"].values()))


def test_one_motor_turns_both_hips() -> None:
    assert [(mirror.joint, mirror.mimics) for mirror in TYPE.mimic_joints] == [("RHipYawPitch", "LHipYawPitch")]
    walking = Walking(FOLDER)
    walking.driver.send([(TYPE.home_rad | {"LHipYawPitch": 0.1})[name] for name in walking.names])
    walking.world.step(200)
    turned = walking.world.snapshot().position_rad
    assert turned["RHipYawPitch"] == pytest.approx(turned["LHipYawPitch"], abs=0.01)


def test_the_pitch_range_of_the_head_depends_on_its_yaw() -> None:
    (narrowing,) = TYPE.position_dependent_limits
    assert (narrowing.joint, narrowing.depends_on) == ("HeadPitch", "HeadYaw")
    ahead, aside = narrowing.at(0.0), narrowing.at(1.5)
    assert ahead[0] < aside[0] < aside[1] < ahead[1]


# ---------------------------------------------------------------- balance


@pytest.mark.parametrize("name", sorted(TYPE.postures))
def test_postures_are_clear_and_balanced(name: str) -> None:
    shape = geometry.load(TYPE, FOLDER)
    assert shape is not None
    position_rad = TYPE.home_rad | TYPE.postures[name]
    assert shape.clearance([position_rad[joint.name] for joint in TYPE.joints]).room_m >= 0
    walking = Walking(FOLDER)
    walking.move(TYPE.postures[name])
    walking.wait(0.5)
    assert walking.upright > UPRIGHT


@pytest.mark.parametrize("name", sorted(TYPE.behaviours))
def test_behaviours_keep_the_robot_standing(name: str) -> None:
    walking = Walking(FOLDER, seed=3)
    for keyframe in TYPE.behaviours[name]:
        if keyframe.position_rad:
            walking.move(keyframe.position_rad, speed=1.0)
    walking.wait(0.5)
    assert walking.least_upright > UPRIGHT
    last = dict(zip(walking.names, walking.controller.update(walking.now_s).position_rad, strict=True))
    assert {name: last[name] for name in LEGS} == pytest.approx({name: TYPE.home_rad[name] for name in LEGS})


def a_day(seed: int) -> None:
    """It sits down, stands up, crouches, stands straight, walks half a metre, turns, and sits down where it then is."""
    walking = Walking(FOLDER, seed=seed)
    for name in ("Sit", "SitRelax", "Sit", "StandInit", "Crouch", "Stand", "StandZero", "StandInit"):
        walking.move(TYPE.postures[name], speed=1.0)
        walking.wait(0.3)
    walking.move(TYPE.home_rad)
    start = walking.torso_m.copy()
    walking.drive(FORWARD, duration_s=6.0)
    assert np.linalg.norm(walking.torso_m[:2] - start[:2]) > 0.5, "it has not walked half a metre"
    walking.drive(Twist(turn_rad_s=0.5), duration_s=2.0)
    walking.drive(Twist(left_m_s=0.08), duration_s=1.5)
    walking.wait(1.0)
    walking.move(TYPE.postures["Sit"], speed=1.0)
    walking.wait(0.5)
    assert walking.least_upright > UPRIGHT, f"seed {seed}: it fell, or nearly"


@pytest.mark.parametrize("seed", range(2))
def test_it_sits_stands_and_walks_without_falling(seed: int) -> None:
    a_day(seed)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2, 20))
def test_it_does_not_fall_with_twenty_seeds(seed: int) -> None:
    a_day(seed)


# ---------------------------------------------------------------- the walk


def test_feet_leave_the_ground_in_turn() -> None:
    walking = Walking(FOLDER)
    course = walking.controller.start_drive(walking.tenure, FORWARD, duration_s=4.0)
    lifted = []
    while not course.finished.is_set():
        walking.period()
        left, right = walking.soles_m > 0.01
        assert not (left and right), "both feet are in the air"
        if left or right:
            lifted.append("left" if left else "right")
    steps = [lifted[0], *(after for before, after in pairwise(lifted) if after != before)]
    assert len(steps) >= 8
    assert all(after != before for before, after in pairwise(steps))


@pytest.mark.parametrize("twist", [Twist(-0.1, 0.0, 0.0), Twist(0.0, -0.1, 0.0), Twist(0.05, 0.05, 0.4)])
def test_it_walks_along_the_commanded_twist(twist: Twist) -> None:
    walking = Walking(FOLDER)
    walking.drive(FORWARD, duration_s=4.0)  # away from its stool
    walking.wait(1.0)
    x, y, yaw = *walking.torso_m[:2], walking.heading_rad
    walking.drive(twist, duration_s=4.0)
    walking.wait(1.0)
    turned = math.remainder(walking.heading_rad - yaw, 2 * math.pi)
    half = yaw + turned / 2
    dx, dy = walking.torso_m[:2] - (x, y)
    chord = 1.0 if twist.turn_rad_s == 0 else math.sin(turned / 2) / (turned / 2)
    gone = np.array([math.cos(half) * dx + math.sin(half) * dy, math.cos(half) * dy - math.sin(half) * dx]) / chord
    assert turned == pytest.approx(4.0 * twist.turn_rad_s, abs=0.15)
    assert gone == pytest.approx([4.0 * twist.forward_m_s, 4.0 * twist.left_m_s], abs=0.05)


def test_odometry_counts_steps_and_drifts_a_little() -> None:
    walking = Walking(FOLDER)
    walking.drive(Twist(forward_m_s=0.1, turn_rad_s=0.2), duration_s=5.0)
    walking.wait(1.0)
    told = walking.driver.report("odometry")
    off_m = math.hypot(told["x_m"] - walking.torso_m[0], told["y_m"] - walking.torso_m[1])
    assert 0 < off_m < 0.05
    assert told["yaw_rad"] == pytest.approx(walking.heading_rad, abs=0.1)
    assert told["forward_m_s"] == told["turn_rad_s"] == 0.0


def test_a_stop_ends_a_walk_on_both_feet_within_the_brakes() -> None:
    walking = Walking(FOLDER)
    walking.controller.start_drive(walking.tenure, FORWARD, duration_s=10.0)
    walking.wait(2.0)
    while walking.soles_m.max() < 0.015:  # with a foot in the air
        walking.period()
    base = TYPE.base
    assert base is not None
    walking.controller.stop(StopLatch(caller="ann", at_ms=0, reason=""))
    braking_s = 0.1 / base.braking_linear_m_s2 + 0.05
    walking.wait(braking_s)
    assert walking.twist == pytest.approx(REST, abs=1e-6)
    there = walking.torso_m.copy()
    walking.wait(1.0)
    assert np.linalg.norm(walking.torso_m[:2] - there[:2]) < 0.03, "it went on"
    assert walking.soles_m.max() < 0.005
    assert walking.applied == pytest.approx(walking.home, abs=1e-6), "the legs are the agent's again"


def test_send_returns_the_gaits_leg_positions_during_a_walk() -> None:
    walking = Walking(FOLDER)
    walking.controller.start_drive(walking.tenure, FORWARD, duration_s=3.0)
    walking.wait(1.5)
    tick = walking.controller.update(walking.now_s + 0.02)
    assert set(tick.limited) >= {"LKneePitch: driver", "RHipPitch: driver"}
    assert not [text for text in tick.limited if text.startswith(("Head", "LShoulder", "LElbow"))]
    asked = [
        value + (0.2 if name == "HeadYaw" else 0.0) for name, value in zip(walking.names, walking.home, strict=True)
    ]
    assert walking.driver.send(asked)[0] == asked[0], "the head is the agent's"


def test_legs_return_slowly_to_the_command_after_a_walk() -> None:
    walking = Walking(FOLDER)
    driver, posture = walking.driver, TYPE.home_rad | TYPE.postures["Crouch"]
    asked = [posture[name] for name in walking.names]
    driver.drive(FORWARD)
    walking.world.step(10)
    knee = walking.names.index("LKneePitch")
    sent: list[float] = []
    while not sent or sent[-1] != asked[knee]:
        driver.drive(REST)
        sent.append(driver.send(asked)[knee])
        walking.world.step(10)
        assert len(sent) < 400
    walked = len(sent) - round((asked[knee] - TYPE.home_rad["LKneePitch"]) / 1.0 / 0.02) - 1
    assert max(abs(after - before) for before, after in pairwise(sent[walked:])) <= 0.02 + 1e-9


def test_it_does_not_walk_while_sitting() -> None:
    walking = Walking(FOLDER)
    walking.move(TYPE.postures["Sit"])
    there = walking.torso_m.copy()
    walking.drive(FORWARD, duration_s=1.0)
    assert walking.driver.drive(FORWARD) == REST
    assert np.linalg.norm(walking.torso_m - there) < 0.01


def test_it_stops_without_new_twists() -> None:
    walking = Walking(FOLDER)
    walking.driver.drive(FORWARD)
    walking.world.step(1500)
    there = walking.torso_m.copy()
    walking.world.step(500)
    assert np.linalg.norm(walking.torso_m - there) < 0.001
    assert walking.driver.report("odometry")["forward_m_s"] == 0.0


def test_the_torso_support_is_limited_and_only_active_during_a_walk() -> None:
    walking = Walking(FOLDER, seed=5)
    assert TYPE.simulation is not None
    walk = TYPE.simulation.walk
    assert walk is not None
    help_now = walking.world._data.xfrc_applied[walking.body]  # not part of a snapshot
    walking.wait(0.5)
    assert not help_now.any()
    course = walking.controller.start_drive(walking.tenure, FORWARD, duration_s=3.0)
    strongest = np.zeros(2)
    while not course.finished.is_set():
        walking.period()
        strongest = np.maximum(strongest, [np.linalg.norm(help_now[:3]), np.linalg.norm(help_now[3:])])
    assert 0 < strongest[0] <= walk.support_n + 1e-9
    assert 0 < strongest[1] <= walk.support_nm + 1e-9
    assert help_now[2] == 0.0, "nothing carries its weight"
    walking.wait(1.0)
    assert not help_now.any()


def test_a_hard_push_makes_it_fall() -> None:
    walking = Walking(FOLDER)
    walking.controller.start_drive(walking.tenure, FORWARD, duration_s=10.0)
    walking.wait(1.0)
    walking.world._data.qvel[:2] = (0.0, 2.0)  # a kick
    walking.wait(2.0)
    assert walking.upright < 0.5
    assert walking.driver.drive(FORWARD) == REST
    assert not walking.world._data.xfrc_applied[walking.body].any()


def test_a_fallen_robot_is_reset_and_can_walk_again() -> None:
    walking = Walking(FOLDER)
    walking.world._data.qvel[:2] = (0.0, 3.0)  # a kick
    walking.world.step(1000)
    assert walking.upright < 0.5
    walking.world.step(5500)
    assert walking.upright > UPRIGHT
    assert walking.torso_m == pytest.approx([0.0, 0.0, walking.model.body("torso").pos[2]], abs=0.01)
    told = walking.driver.report("odometry")
    assert (told["x_m"], told["y_m"], told["yaw_rad"]) == (0.0, 0.0, 0.0)
    walking.drive(FORWARD, duration_s=2.0)
    assert walking.torso_m[0] > 0.1


@pytest.mark.parametrize(
    ("change", "says"),
    [({"base": None}, r"has no \[base\]"), ({"simulation": None}, r"no \[simulation.walk\]")],
)
def test_a_type_without_walk_is_rejected(change: dict[str, Any], says: str) -> None:
    kind = msgspec.structs.replace(TYPE, **change)
    with pytest.raises(DriverError, match=says):
        BipedDriver(robot_type=kind, world=World(FOLDER / TYPE.scene), device="walker")


def test_invalid_twists_are_rejected_and_fast_ones_limited() -> None:
    walking = Walking(FOLDER)
    with pytest.raises(DriverError, match="not finite"):
        walking.driver.drive(Twist(math.nan, 0.0, 0.0))
    assert walking.driver.drive(Twist(5.0, -5.0, 9.0)) == Twist(0.1, -0.1, 0.5)


def test_the_manifest_selects_the_driver() -> None:
    assert isinstance(create(TYPE, FOLDER, {}, "nao"), BipedDriver)
    still = msgspec.structs.replace(TYPE, simulation=None)
    assert type(create(still, FOLDER, {}, "nao")) is MujocoDriver
