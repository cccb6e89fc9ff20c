"""NAO against its published figures; its balance and walk."""

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import mujoco
import numpy as np
import numpy.typing as npt
import pytest

from device_agent.drivers.mujoco import BipedDriver, MujocoDriver, World, create
from device_agent.ports.driver import REST, DriverError, Twist
from device_agent.protocol import StopLatch
from device_agent.protocol.manifests import robot_type
from tests.harness.paths import ROBOTS
from tests.unit.robots.simulated_robot import SimulatedRobot

pytestmark = pytest.mark.slow
FOLDER = ROBOTS / "nao"
TYPE = robot_type.load(FOLDER)
FACTS: dict[str, Any] = json.loads((Path(__file__).parent / "nao_v5.json").read_text(encoding="utf-8"))
FINGERS = {"l_wrist": "LFingers", "r_wrist": "RFingers"}
"""Separate bodies in this model; the description includes their mass in the wrist."""
LEGS = [joint.name for joint in TYPE.joints if joint.name[1:].startswith(("Hip", "Knee", "Ankle"))]
FORWARD = Twist(forward_m_s=0.1)
UPRIGHT = 0.95
"""Cosine of the torso's tilt: 18 degrees, more than any posture leans."""


@pytest.fixture
def nao() -> SimulatedRobot:
    return SimulatedRobot(FOLDER)


def start_walk(nao: SimulatedRobot, duration_s: float = 10.0) -> Any:
    return nao.controller.start_drive(nao.reservation, FORWARD, duration_s=duration_s)


def soles_m(nao: SimulatedRobot) -> npt.NDArray[Any]:
    """Height of both soles [m]."""
    sites = [nao.model.site(name).id for name in ("LLeg", "RLeg")]
    return np.array(nao.world.snapshot().site_position_m[sites][:, 2])


# ---------------------------------------------------------------- figures


def test_joints_and_masses_are_those_of_the_description() -> None:
    model = mujoco.MjModel.from_xml_path(str(FOLDER / TYPE.model))
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
        if not joint.name.endswith("Hand"):  # README.md: fingers are simplified
            assert in_model.axis == pytest.approx(np.array(fact["axis"]) / np.linalg.norm(fact["axis"]), abs=1e-6)
    for name, mass_kg in FACTS["masses_kg"].items():
        parts = [name, FINGERS[name]] if name in FINGERS else [name]
        assert sum(model.body(part).mass[0] for part in parts) == pytest.approx(mass_kg, abs=1e-9)
    assert model.body_subtreemass[model.body("torso").id] == pytest.approx(sum(FACTS["masses_kg"].values()))


def test_one_motor_turns_both_hips(nao: SimulatedRobot) -> None:
    assert [(mirror.joint, mirror.mimics) for mirror in TYPE.mimic_joints] == [("RHipYawPitch", "LHipYawPitch")]
    nao.driver.send([(TYPE.home_rad | {"LHipYawPitch": 0.1})[name] for name in nao.names])
    nao.world.step(200)
    turned = nao.world.snapshot().position_rad
    assert turned["RHipYawPitch"] == pytest.approx(turned["LHipYawPitch"], abs=0.01)


def test_the_pitch_range_of_the_head_depends_on_its_yaw() -> None:
    (narrowing,) = TYPE.position_dependent_limits
    assert (narrowing.joint, narrowing.depends_on) == ("HeadPitch", "HeadYaw")
    ahead, aside = narrowing.at(0.0), narrowing.at(1.5)
    assert ahead[0] < aside[0] < aside[1] < ahead[1]


# ---------------------------------------------------------------- balance


@pytest.mark.parametrize("name", sorted(TYPE.postures))
def test_postures_are_balanced(nao: SimulatedRobot, name: str) -> None:
    nao.move(TYPE.postures[name])
    nao.wait(0.5)
    assert nao.upright > UPRIGHT


@pytest.mark.parametrize("name", sorted(TYPE.behaviours))
def test_behaviours_keep_the_robot_standing(name: str) -> None:
    nao = SimulatedRobot(FOLDER, seed=3)
    for keyframe in TYPE.behaviours[name]:
        if keyframe.position_rad:
            nao.move(keyframe.position_rad, speed=1.0)
    nao.wait(0.5)
    assert nao.least_upright > UPRIGHT
    last = dict(zip(nao.names, nao.controller.commanded_rad, strict=True))
    assert {name: last[name] for name in LEGS} == pytest.approx({name: TYPE.home_rad[name] for name in LEGS})


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(2, 20))])
def test_it_sits_stands_and_walks_without_falling(seed: int) -> None:
    nao = SimulatedRobot(FOLDER, seed=seed)
    for name in ("Sit", "SitRelax", "Sit", "StandInit", "Crouch", "Stand", "StandZero", "StandInit"):
        nao.move(TYPE.postures[name], speed=1.0)
        nao.wait(0.3)
    nao.move(TYPE.home_rad)
    start_m = nao.position_m[:2]
    nao.drive(FORWARD, duration_s=6.0)
    assert math.dist(nao.position_m[:2], start_m) > 0.5
    nao.drive(Twist(turn_rad_s=0.5), duration_s=2.0)
    nao.drive(Twist(left_m_s=0.08), duration_s=1.5)
    nao.wait(1.0)
    nao.move(TYPE.postures["Sit"], speed=1.0)
    nao.wait(0.5)
    assert nao.least_upright > UPRIGHT


# ---------------------------------------------------------------- the walk


def test_feet_leave_the_ground_in_turn(nao: SimulatedRobot) -> None:
    goal = start_walk(nao, 4.0)
    steps: list[str] = []
    while not goal.finished.is_set():
        nao.run_period()
        left, right = soles_m(nao) > 0.01
        assert not (left and right), "both feet are in the air"
        lifted = "left" if left else "right" if right else ""
        if lifted and steps[-1:] != [lifted]:
            steps.append(lifted)
    assert len(steps) >= 8


@pytest.mark.parametrize("twist", [Twist(-0.1, 0.0, 0.0), Twist(0.0, -0.1, 0.0), Twist(0.05, 0.05, 0.4)])
def test_it_walks_along_the_commanded_twist(nao: SimulatedRobot, twist: Twist) -> None:
    nao.drive(FORWARD, duration_s=4.0)  # away from its stool
    nao.wait(1.0)
    x, y, yaw = nao.pose
    nao.drive(twist, duration_s=4.0)
    nao.wait(1.0)
    turned = math.remainder(nao.pose[2] - yaw, 2 * math.pi)
    half = yaw + turned / 2
    dx, dy = nao.position_m[:2] - (x, y)
    chord = 1.0 if twist.turn_rad_s == 0 else math.sin(turned / 2) / (turned / 2)
    walked = np.array([math.cos(half) * dx + math.sin(half) * dy, math.cos(half) * dy - math.sin(half) * dx]) / chord
    assert turned == pytest.approx(4.0 * twist.turn_rad_s, abs=0.15)
    assert walked == pytest.approx([4.0 * twist.forward_m_s, 4.0 * twist.left_m_s], abs=0.05)


def test_odometry_counts_steps_and_drifts_a_little(nao: SimulatedRobot) -> None:
    nao.drive(Twist(forward_m_s=0.1, turn_rad_s=0.2), duration_s=5.0)
    nao.wait(1.0)
    odometry, (x_m, y_m, yaw_rad) = nao.driver.report("odometry"), nao.pose
    assert 0 < math.dist((odometry["x_m"], odometry["y_m"]), (x_m, y_m)) < 0.05
    assert odometry["yaw_rad"] == pytest.approx(yaw_rad, abs=0.1)
    assert odometry["forward_m_s"] == odometry["turn_rad_s"] == 0.0


def test_a_stop_ends_a_walk_on_both_feet_within_the_brakes(nao: SimulatedRobot) -> None:
    assert TYPE.base is not None
    start_walk(nao)
    nao.wait(2.0)
    while soles_m(nao).max() < 0.015:  # with a foot in the air
        nao.run_period()
    nao.controller.stop(StopLatch(caller="ann", at_ms=0, reason=""))
    nao.wait(0.1 / TYPE.base.braking_linear_m_s2 + 0.05)
    assert nao.twist == pytest.approx(REST, abs=1e-6)
    stopped_m = nao.position_m[:2]
    nao.wait(1.0)
    assert math.dist(nao.position_m[:2], stopped_m) < 0.03
    assert soles_m(nao).max() < 0.005
    assert nao.applied_rad == pytest.approx(nao.home_rad, abs=1e-6), "the agent controls the legs again"


def test_send_returns_the_gaits_leg_positions_during_a_walk(nao: SimulatedRobot) -> None:
    start_walk(nao)
    nao.wait(1.5)
    tick = nao.controller.update(nao.now_s + 0.02)
    assert set(tick.limited) >= {"LKneePitch: driver", "RHipPitch: driver"}
    assert not [text for text in tick.limited if text.startswith(("Head", "LShoulder", "LElbow"))]
    assert nao.names[0] == "HeadYaw"
    assert nao.driver.send([0.2, *nao.home_rad[1:]])[0] == 0.2, "the agent controls the head"


def test_legs_return_slowly_to_the_command_after_a_walk(nao: SimulatedRobot) -> None:
    posture = TYPE.home_rad | TYPE.postures["Crouch"]
    target = [posture[name] for name in nao.names]
    nao.driver.drive(FORWARD)
    nao.world.step(10)
    knee = nao.names.index("LKneePitch")
    sent: list[float] = []
    while not sent or sent[-1] != target[knee]:
        nao.driver.drive(REST)
        sent.append(nao.driver.send(target)[knee])
        nao.world.step(10)
        assert len(sent) < 400
    walked = len(sent) - round((target[knee] - TYPE.home_rad["LKneePitch"]) / 1.0 / 0.02) - 1
    assert max(abs(after - before) for before, after in pairwise(sent[walked:])) <= 0.02 + 1e-9


def test_it_does_not_walk_while_sitting(nao: SimulatedRobot) -> None:
    nao.move(TYPE.postures["Sit"])
    sitting_m = nao.position_m
    nao.drive(FORWARD, duration_s=1.0)
    assert nao.driver.drive(FORWARD) == REST
    assert math.dist(nao.position_m, sitting_m) < 0.01


def test_it_stops_without_new_twists(nao: SimulatedRobot) -> None:
    nao.driver.drive(FORWARD)
    nao.world.step(1500)
    stopped_m = nao.position_m
    nao.world.step(500)
    assert math.dist(nao.position_m, stopped_m) < 0.001
    assert nao.driver.report("odometry")["forward_m_s"] == 0.0


def test_the_torso_support_is_limited_and_only_active_during_a_walk() -> None:
    nao = SimulatedRobot(FOLDER, seed=5)
    assert TYPE.simulation is not None
    walk = TYPE.simulation.walk
    assert walk is not None
    support = nao.world._data.xfrc_applied[nao.body]  # not part of a snapshot
    nao.wait(0.5)
    assert not support.any()
    goal = start_walk(nao, 3.0)
    strongest = np.zeros(2)
    while not goal.finished.is_set():
        nao.run_period()
        strongest = np.maximum(strongest, [np.linalg.norm(support[:3]), np.linalg.norm(support[3:])])
    assert 0 < strongest[0] <= walk.support_n + 1e-9
    assert 0 < strongest[1] <= walk.support_nm + 1e-9
    assert support[2] == 0.0, "nothing carries its weight"
    nao.wait(1.0)
    assert not support.any()


def test_a_hard_push_makes_it_fall(nao: SimulatedRobot) -> None:
    start_walk(nao)
    nao.wait(1.0)
    nao.world._data.qvel[:2] = (0.0, 2.0)  # a kick
    nao.wait(2.0)
    assert nao.upright < 0.5
    assert nao.driver.drive(FORWARD) == REST
    assert not nao.world._data.xfrc_applied[nao.body].any()


def test_a_fallen_robot_is_reset_and_can_walk_again(nao: SimulatedRobot) -> None:
    nao.world._data.qvel[:2] = (0.0, 3.0)  # a kick
    nao.world.step(1000)
    assert nao.upright < 0.5
    nao.world.step(5500)
    assert nao.upright > UPRIGHT
    assert nao.position_m == pytest.approx([0.0, 0.0, nao.model.body("torso").pos[2]], abs=0.01)
    odometry = nao.driver.report("odometry")
    assert (odometry["x_m"], odometry["y_m"], odometry["yaw_rad"]) == (0.0, 0.0, 0.0)
    nao.drive(FORWARD, duration_s=2.0)
    assert nao.position_m[0] > 0.1


def test_invalid_twists_are_rejected_and_fast_ones_limited(nao: SimulatedRobot) -> None:
    with pytest.raises(DriverError, match="not finite"):
        nao.driver.drive(Twist(math.nan, 0.0, 0.0))
    assert nao.driver.drive(Twist(5.0, -5.0, 9.0)) == Twist(0.1, -0.1, 0.5)


def test_the_manifest_selects_the_driver() -> None:
    assert isinstance(create(TYPE, FOLDER, {}, "nao"), BipedDriver)
    still = msgspec.structs.replace(TYPE, simulation=None)
    assert type(create(still, FOLDER, {}, "nao")) is MujocoDriver
    no_base = msgspec.structs.replace(TYPE, base=None)
    for kind, message in ((no_base, r"has no \[base\]"), (still, r"no \[simulation.walk\]")):
        with pytest.raises(DriverError, match=message):
            BipedDriver(robot_type=kind, world=World(FOLDER / TYPE.scene), device="nao")
