"""The Hanson-style head: rods and threads, a gaze of two eyes, and distinct expressions."""

import math
from itertools import combinations

import mujoco
import numpy as np
import pytest

from device_agent import geometry
from device_agent.ports.geometry import RobotGeometry
from device_agent.runtime.planning import gaze
from device_agent.runtime.planning.behaviour_trajectory import BehaviourTrajectory, SpokenLine
from device_agent.runtime.planning.visemes import estimate_duration_s
from device_agent.simulation.mjcf.equality_joints import EqualityJoints
from tests.harness.paths import ROBOTS
from tests.unit.robots.folders import SteppedRobot

pytestmark = pytest.mark.slow
FOLDER = ROBOTS / "hanson"
PUBLISHED_RAD = {
    "Neck-Rotation": (-1.325, 1.282),
    "Upper-Gimbal-L": (-0.798, 1.917),
    "Upper-Gimbal-R": (-2.086, 0.813),
    "Lower-Gimbal-L": (-1.246, 0.595),
    "Lower-Gimbal-R": (-0.506, 1.485),
    "Jaw": (0, 1.58),
}
"""Ranges in hansonrobotics/HEAD motors.yaml, with three decimals."""
BASIC_EMOTIONS = {"happy", "sad", "angry", "surprised", "afraid", "disgusted"}
"""By Ekman."""


@pytest.fixture
def bench() -> SteppedRobot:
    return SteppedRobot(FOLDER)


@pytest.fixture(scope="module")
def shape() -> RobotGeometry:
    shape = geometry.load(SteppedRobot(FOLDER).type, FOLDER)
    assert shape is not None
    return shape


def test_joint_ranges_are_the_published_ones(bench: SteppedRobot):
    joints = {joint.name: (joint.lower_rad, joint.upper_rad) for joint in bench.type.joints}
    for name, range_rad in PUBLISHED_RAD.items():
        assert joints[name] == pytest.approx(range_rad, abs=6e-4), name


def test_dependent_joints_follow_the_equality_constraints(bench: SteppedRobot, shape: RobotGeometry):
    equality_joints = EqualityJoints(bench.model)
    assert len(equality_joints.all) == 21
    target = np.random.default_rng(2).uniform(bench.lower, bench.upper)
    bench.data.ctrl[bench.ctrl] = target
    bench.step(1500)
    assert bench.data.qpos[bench.qpos] == pytest.approx(target, abs=1e-3)
    settled = bench.data.qpos.copy()
    equality_joints.apply(settled)
    assert settled == pytest.approx(bench.data.qpos, abs=1e-3)
    for frame, pose in shape.poses(target.tolist()).items():
        assert pose[:3] == pytest.approx(bench.data.site(frame).xpos, abs=1e-4)


def test_clearance_and_speed_include_dependent_joints(bench: SteppedRobot, shape: RobotGeometry):
    upright = bench.home.tolist()
    leaning = dict(zip(bench.names, upright, strict=True)) | {"Lower-Gimbal-L": -1.2, "Lower-Gimbal-R": 1.4}
    assert shape.clearance(list(leaning.values())).excess_m < shape.clearance(upright).excess_m - 0.005
    one = [1.0 if name == "Lower-Gimbal-R" else 0.0 for name in bench.names]
    assert shape.speed_m_s(one) > 0.03, "a motor moves what its rod carries"


def test_it_moves_its_head_less_than_its_motors(bench: SteppedRobot):
    bench.data.ctrl[[bench.model.actuator(name).id for name in ("Upper-Gimbal-L", "Upper-Gimbal-R")]] = 1.9, -2.0
    bench.step(1500)
    assert bench.data.joint("head_pitch").qpos[0] == pytest.approx(0.15 * 3.9, abs=0.01)


@pytest.mark.parametrize("point_m", [(1.0, 0.0, 0.4), (0.45, 0.1, 0.3), (0.3, -0.25, 0.5), (1.0, 1.0, 0.3)])
def test_eyes_and_neck_look_at_a_point(bench: SteppedRobot, shape: RobotGeometry, point_m: tuple[float, float, float]):
    position = dict(zip(bench.names, bench.home.tolist(), strict=True))
    position |= gaze.solve_gaze(bench.type, shape, bench.home.tolist(), point_m)
    poses = shape.poses([position[name] for name in bench.names])
    for eye in ("eye_left", "eye_right"):
        x, y, z, *quaternion = poses[eye]
        ahead = np.empty(3)
        mujoco.mju_rotVecQuat(ahead, np.array([1.0, 0.0, 0.0]), np.array(quaternion))
        direction = np.array(point_m) - (x, y, z)
        assert math.acos(min(1.0, float(ahead @ direction / np.linalg.norm(direction)))) < 0.005
    assert abs(position["EyeTurn-L"]) < 0.5, "the neck takes its share"


def test_expressions_are_distinct(bench: SteppedRobot):
    assert set(bench.type.expressions) >= BASIC_EMOTIONS | {"neutral", "thinking", "sleepy"}
    faces = {
        name: np.array([pose.get(joint, 0.0) for joint in bench.names]) / (bench.upper - bench.lower)
        for name, pose in bench.type.expressions.items()
    }
    for (one, first), (other, second) in combinations(faces.items(), 2):
        assert np.abs(first - second).max() > 0.2, f"{one} and {other}"


def test_visemes_reach_their_mouth_shapes(bench: SteppedRobot):
    visemes = bench.type.visemes
    assert len(visemes) >= 12
    assert all(
        joint.startswith(("Jaw", "Lip", "EE-oo", "Smile", "Frown")) for pose in visemes.values() for joint in pose
    )
    text = "Hello, I am a robot, and I am glad to see all of you at the table today."
    speech = BehaviourTrajectory(bench.type, bench.home.tolist())
    speech.add_speech(SpokenLine(0.0, text, estimate_duration_s(text)))
    path, jaw = speech.trajectory(), bench.names.index("Jaw")
    assert path.position_rad[:, jaw].max() == pytest.approx(visemes["aa"]["Jaw"], abs=1e-3)
    widest_rad = 0.0
    for time_s in np.arange(0.0, path.duration_s, bench.model.opt.timestep):
        bench.data.ctrl[bench.ctrl] = path.at(float(time_s))[0]
        bench.step()
        widest_rad = max(widest_rad, bench.data.qpos[bench.qpos][jaw])
    assert widest_rad > 0.95 * visemes["aa"]["Jaw"], "the servo follows"
