"""The Hanson-style head: rods and threads, a gaze of two eyes, and faces that differ."""

import math
from itertools import combinations

import mujoco
import numpy as np
import pytest

from device_agent import geometry
from device_agent.runtime.planning import gaze
from device_agent.runtime.planning import visemes as mouth
from device_agent.runtime.planning.behaviour_trajectory import BehaviourTrajectory, SpokenLine
from device_agent.simulation.mjcf.equality_joints import EqualityJoints
from tests.harness.paths import ROBOTS
from tests.unit.robots.folders import Bench

FOLDER = ROBOTS / "hanson"
SIX = {"happy", "sad", "angry", "surprised", "afraid", "disgusted"}
"""Ekman's basic emotions."""


@pytest.fixture
def bench() -> Bench:
    return Bench(FOLDER)


def test_dependent_joints_follow_the_equality_constraints(bench: Bench):
    equality_joints = EqualityJoints(bench.model)
    assert len(equality_joints.all) == 21
    random = np.random.default_rng(2)
    bench.data.ctrl[bench.ctrl] = random.uniform(bench.lower, bench.upper)
    mujoco.mj_step(bench.model, bench.data, nstep=1500)
    assert bench.data.qpos[bench.qpos] == pytest.approx(bench.data.ctrl[bench.ctrl], abs=1e-3)
    settled = bench.data.qpos.copy()
    equality_joints.apply(settled)
    assert settled == pytest.approx(bench.data.qpos, abs=1e-3)


def test_limits_include_dependent_joints(bench: Bench):
    shape = geometry.load(bench.type, FOLDER)
    assert shape is not None
    random = np.random.default_rng(5)
    target = random.uniform(bench.lower, bench.upper)
    bench.data.ctrl[bench.ctrl] = target
    mujoco.mj_step(bench.model, bench.data, nstep=1500)
    for frame, pose in shape.poses(target.tolist()).items():
        assert pose[:3] == pytest.approx(bench.data.site(frame).xpos, abs=1e-4)
    upright = bench.home.tolist()
    leaning = dict(zip(bench.names, upright, strict=True)) | {"Lower-Gimbal-L": -1.2, "Lower-Gimbal-R": 1.4}
    assert shape.clearance(list(leaning.values())).room_m < shape.clearance(upright).room_m - 0.005
    one = [1.0 if name == "Lower-Gimbal-R" else 0.0 for name in bench.names]
    assert shape.speed_m_s(one) > 0.03, "a motor is known to carry what its rod carries"


def test_it_moves_its_head_less_than_its_motors(bench: Bench):
    pitch = bench.model.joint("head_pitch").qposadr[0]
    bench.data.ctrl[[bench.model.actuator(name).id for name in ("Upper-Gimbal-L", "Upper-Gimbal-R")]] = 1.9, -2.0
    mujoco.mj_step(bench.model, bench.data, nstep=1500)
    assert bench.data.qpos[pitch] == pytest.approx(0.15 * 3.9, abs=0.01)


@pytest.mark.parametrize("point_m", [(1.0, 0.0, 0.4), (0.45, 0.1, 0.3), (0.3, -0.25, 0.5), (1.0, 1.0, 0.3)])
def test_eyes_and_neck_look_at_a_point(bench: Bench, point_m: tuple[float, float, float]):
    shape = geometry.load(bench.type, FOLDER)
    assert shape is not None
    position = dict(zip(bench.names, bench.home.tolist(), strict=True))
    position |= gaze.solve_gaze(bench.type, shape, bench.home.tolist(), point_m)
    poses = shape.poses([position[name] for name in bench.names])
    for eye in ("eye_left", "eye_right"):
        x, y, z, *quaternion = poses[eye]
        ahead = np.empty(3)
        mujoco.mju_rotVecQuat(ahead, np.array([1.0, 0.0, 0.0]), np.array(quaternion))
        way = np.array(point_m) - (x, y, z)
        assert math.acos(min(1.0, float(ahead @ way / np.linalg.norm(way)))) < 0.005
    assert abs(position["EyeTurn-L"]) < 0.5, "the neck takes its share"


def test_expressions_are_distinct(bench: Bench):
    shown = bench.type.expressions
    assert set(shown) >= SIX | {"neutral", "thinking", "sleepy"}
    faces = {
        name: np.array([pose.get(joint, 0.0) for joint in bench.names]) / (bench.upper - bench.lower)
        for name, pose in shown.items()
    }
    for (one, first), (other, second) in combinations(faces.items(), 2):
        assert np.abs(first - second).max() > 0.2, f"{one} and {other}"


def test_its_mouth_has_a_dozen_shapes(bench: Bench):
    assert len(bench.type.visemes) >= 12
    mouth = ("Jaw", "Lip", "EE-oo", "Smile", "Frown")
    assert all(joint.startswith(mouth) for pose in bench.type.visemes.values() for joint in pose)


def test_visemes_reach_their_mouth_shapes(bench: Bench):
    text = "Hello, I am a robot, and I am glad to see all of you at the table today."
    score = BehaviourTrajectory(bench.type, bench.home.tolist())
    score.add_speech(SpokenLine(0.0, text, mouth.estimate_duration_s(text)))
    way, jaw = score.trajectory(), bench.names.index("Jaw")
    assert way.position_rad[:, jaw].max() == pytest.approx(bench.type.visemes["aa"]["Jaw"], abs=1e-3)
    follows = []
    for time_s in np.arange(0.0, way.duration_s, bench.model.opt.timestep):
        bench.data.ctrl[bench.ctrl] = way.at(float(time_s))[0]
        mujoco.mj_step(bench.model, bench.data)
        follows.append(bench.data.qpos[bench.qpos][jaw])
    assert max(follows) > 0.95 * bench.type.visemes["aa"]["Jaw"], "the servo follows"
