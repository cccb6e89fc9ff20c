"""The UR5 against its published measures."""

import math

import mujoco
import numpy as np
import numpy.typing as npt
import pytest

from tests.harness.paths import ROBOTS
from tests.unit.robots.folders import SteppedRobot

FOLDER = ROBOTS / "ur5"
# UR's article on DH parameters: a [m], d [m], alpha [rad] of joints 1 to 6.
A = (0.0, -0.425, -0.39225, 0.0, 0.0, 0.0)
D = (0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823)
ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
MASS_KG = (3.7, 8.393, 2.275, 1.219, 1.219, 0.1879)
LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1_link", "wrist_2_link", "wrist_3_link")
SERVO_LAG_S = 0.02  # kv/kp of every servo
FRAMES = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "flange")


def dh_frames(position: npt.NDArray[np.float64]) -> list[npt.NDArray[np.float64]]:
    """Frames 1 to 6 by the standard convention: Rz(q) Tz(d) Tx(a) Rx(alpha)."""
    pose, frames = np.eye(4), []
    for q, a, d, alpha in zip(position, A, D, ALPHA, strict=True):
        cq, sq, ca, sa = np.cos(q), np.sin(q), np.cos(alpha), np.sin(alpha)
        link = [[cq, -sq * ca, sq * sa, a * cq], [sq, cq * ca, -cq * sa, a * sq], [0, sa, ca, d], [0, 0, 0, 1]]
        pose = pose @ np.array(link)
        frames.append(pose)
    return frames


@pytest.fixture
def bench() -> SteppedRobot:
    return SteppedRobot(FOLDER)


def test_every_frame_is_its_dh_frame_over_1000_random_poses(bench: SteppedRobot):
    random = np.random.default_rng(2026)
    worst_m = worst_rad = 0.0
    for _ in range(1000):
        position = random.uniform(bench.lower, bench.upper)
        bench.place(position)
        for name, frame in zip(FRAMES, dh_frames(position), strict=True):
            site = bench.data.site(name)
            worst_m = max(worst_m, float(np.linalg.norm(site.xpos - frame[:3, 3])))
            # |R - I| (Frobenius) of the rotation between them is sqrt(2) times the angle, for a small one.
            between = site.xmat.reshape(3, 3).T @ frame[:3, :3]
            worst_rad = max(worst_rad, float(np.linalg.norm(between - np.eye(3)) / np.sqrt(2)))
    assert worst_m < 1e-6
    assert worst_rad < 1e-6


def test_the_model_is_the_published_arm(bench: SteppedRobot):
    model = bench.model
    assert bench.names == ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
    assert [joint.label for joint in bench.type.joints] == [
        "Base", "Shoulder", "Elbow", "Wrist 1", "Wrist 2", "Wrist 3",
    ]  # fmt: skip
    for joint in bench.type.joints:
        range_rad = np.pi if joint.name == "elbow" else 2 * np.pi  # the elbow's range is narrowed for planning
        assert (joint.lower_rad, joint.upper_rad) == pytest.approx((-range_rad, range_rad), abs=6e-4)
        assert joint.max_velocity_rad_s <= np.pi + 6e-4
    assert [model.body(name).mass[0] for name in LINKS] == pytest.approx(MASS_KG)
    for link, offset_m in (("upper_arm", 0.13585), ("forearm", 0.13585 - 0.1197)):
        tubes = model.geom_bodyid == model.body(link).id
        assert np.abs(model.geom_pos[tubes, 2] - offset_m).min() < 1e-6
    visual = model.geom_group == 2
    assert visual.sum() > 20
    assert not model.geom_contype[visual].any()
    assert not model.geom_conaffinity[visual].any()
    bench.place(np.full(6, 0.7))
    assert bench.data.site("wrist_3").xpos == pytest.approx(bench.data.site("flange").xpos, abs=1e-12)


def test_motors_do_the_work_of_holding_the_arm(bench: SteppedRobot):
    bench.step(10)
    effort = bench.data.qfrc_actuator[bench.dof]
    assert effort == pytest.approx(bench.data.qfrc_bias[bench.dof], abs=0.05)
    assert abs(effort[1]) > 10


def _demand(bench: SteppedRobot, acceleration: float, velocity: float, seed: int) -> npt.NDArray[np.float64]:
    """Torque of each joint if all six accelerate in the worst directions, shape (samples, 6) [N m]."""
    random = np.random.default_rng(seed)
    stretched = np.array([0.0, 0.0, 0.0, -np.pi / 2, np.pi / 2, 0.0])
    samples = []
    for index in range(1500):
        position = stretched if index == 0 else random.uniform(-np.pi, np.pi, 6)
        bench.place(position, random.choice([-1.0, 1.0], 6) * velocity)
        inertia = np.zeros((6, 6))
        for joint in range(6):
            mujoco.mj_mulM(bench.model, bench.data, inertia[joint], np.eye(6)[joint])
        samples.append(np.abs(bench.data.qfrc_bias) + acceleration * np.abs(inertia).sum(axis=1))
    return np.array(samples)


@pytest.mark.slow
def test_motors_can_accelerate_in_any_pose_and_brake_in_most(bench: SteppedRobot):
    effort = np.array([joint.max_effort_nm for joint in bench.type.joints])
    for velocity in (0.0, np.pi):
        assert (_demand(bench, 8.0, velocity, 1) <= effort).all()
    beyond = (_demand(bench, bench.type.braking_rad_s2, np.pi, 2) > effort).any(axis=1)
    assert beyond.mean() < 0.1


@pytest.mark.slow
def test_braking_from_full_speed_stops_the_arm_in_the_air(bench: SteppedRobot):
    """All six joints at 180°/s, braked as the watchdog does, from random poses and the stretched one.

    60 ms after the command is at zero the arm is at rest (0.1 rad/s) in nine of ten; after 200 ms in all, also where
    the motors saturate.
    """
    random = np.random.default_rng(7)
    bench.model.geom_contype[:] = 0  # in the air: only the servos count
    bench.model.geom_conaffinity[:] = 0
    bench.model.jnt_limited[:] = 0
    bench.model.actuator_ctrllimited[:] = 0
    braking, period_s = bench.type.braking_rad_s2, bench.type.period_ms / 1000
    periods = math.ceil(np.pi / braking / period_s)
    after_60_ms, after_200_ms = [], []
    for index in range(60):
        speed = random.choice([-1.0, 1.0], 6) * np.pi
        position = np.array([0, 0, 0, 0, 1.5, 0]) if index == 0 else random.uniform(-np.pi, np.pi, 6)
        bench.place(position, speed)
        target = position + speed * SERVO_LAG_S
        residual = []
        for _ in range(periods + 25):
            next_speed = np.sign(speed) * np.maximum(np.abs(speed) - braking * period_s, 0.0)
            step_rad = (speed + next_speed) / 2 * period_s
            for part in range(1, 5):  # the driver's straight line between two targets
                bench.data.ctrl[bench.ctrl] = target + step_rad * part / 4
                bench.step()
            target, speed = target + step_rad, next_speed
            residual.append(float(np.abs(bench.data.qvel[bench.dof]).max()))
        after_60_ms.append(residual[periods + 7])
        after_200_ms.append(residual[-1])
    assert np.quantile(after_60_ms, 0.9) < 0.1
    assert max(after_200_ms) < 0.1


def test_servo_follows_a_steady_motion_20_ms_behind(bench: SteppedRobot):
    speed = np.full(6, 0.5)
    bench.place(np.array([0.0, -1.5, 1.5, -1.5, -1.5, 0.0]), speed)
    start = bench.data.qpos[bench.qpos].copy()
    for step in range(200):
        bench.data.ctrl[bench.ctrl] = start + speed * (step + 1) * 0.002
        bench.step()
    behind = bench.data.ctrl[bench.ctrl] - bench.data.qpos[bench.qpos]
    assert behind / speed == pytest.approx(np.full(6, SERVO_LAG_S), abs=0.003)
