"""The SO-100 and the Koch arm against their published measures."""

import mujoco
import numpy as np
import numpy.typing as npt
import pytest

from tests.harness.paths import ROBOTS
from tests.unit.robots.folders import SteppedRobot

Chain = list[tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], float, float]]
"""For each joint: origin in its parent's frame [m] and [rad], axis, lower and upper end of the range [rad]."""
FRAMES = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")

SO100: Chain = [
    ((0.0, -0.0452, 0.0165), (1.57079, 0.0, 0.0), (0.0, -1.0, 0.0), -2.0, 2.0),  # reversed: see the README
    ((0.0, 0.1025, 0.0306), (-1.8, 0.0, 0.0), (1.0, 0.0, 0.0), 0.0, 3.5),
    ((0.0, 0.11257, 0.028), (1.57079, 0.0, 0.0), (1.0, 0.0, 0.0), -3.14158, 0.0),
    ((0.0, 0.0052, 0.1349), (-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), -2.5, 1.2),
    ((0.0, -0.0601, 0.0), (0.0, 1.57079, 0.0), (0.0, 1.0, 0.0), -3.14158, 3.14158),
    ((-0.0202, -0.0244, 0.0), (0.0, 3.14158, 0.0), (0.0, 0.0, 1.0), -0.2, 2.0),
]
"""``so100.urdf``."""
KOCH: Chain = [
    ((0.012, 0.0, 0.0409), (0.0, 0.0, 0.0), (0.0, 0.0, -1.0), -2.2, 2.2),
    ((0.0, -0.0209, 0.0154), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), -1.57, 0.6),
    ((-0.0148, 0.0065, 0.1083), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), -1.57, 1.45),
    ((-0.10048, 5e-05, 0.0026999), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), -2.0, 2.0),
    ((-0.045, 0.013097, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), -3.14, 3.14),
    ((-0.01315, -0.0075, 0.0145), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), -0.032, 1.6),  # reversed: see the README
]
"""``low_cost_robot_arm``, where x points backward."""
MASS_KG = {
    "so100": (0.119226, 0.162409, 0.147968, 0.0661321, 0.0929859, 0.0202444),
    "koch": (0.05014, 0.050177, 0.06379, 0.019805, 0.029277, 0.012831),
}
BODIES = ("shoulder", "upper_arm", "lower_arm", "wrist", "gripper", "jaw")
STALL_NM = {"so100": (1.9,) * 6, "koch": (1.5, 1.5, 0.52, 0.52, 0.52, 0.52)}
NO_LOAD_RAD_S = {"so100": (5.4,) * 6, "koch": (6.4, 6.4, 10.8, 10.8, 10.8, 10.8)}
arms = pytest.mark.parametrize(
    ("name", "chain", "to_base"),
    [
        ("so100", SO100, ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))),
        ("koch", KOCH, ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))),
    ],
)


def transform(position_m: tuple[float, ...], rpy_rad: tuple[float, ...]) -> npt.NDArray[np.float64]:
    """Pose of an origin of a URDF."""
    quaternion, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_euler2Quat(quaternion, np.array(rpy_rad), "XYZ")
    mujoco.mju_quat2Mat(matrix, quaternion)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = matrix.reshape(3, 3), position_m
    return pose


def turn(axis: tuple[float, ...], angle_rad: float) -> npt.NDArray[np.float64]:
    """Pose of a joint that has turned."""
    quaternion, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(quaternion, np.array(axis), angle_rad)
    mujoco.mju_quat2Mat(matrix, quaternion)
    pose = np.eye(4)
    pose[:3, :3] = matrix.reshape(3, 3)
    return pose


def published(chain: Chain, position_rad: npt.NDArray[np.float64]) -> list[npt.NDArray[np.float64]]:
    """Pose of each joint's frame before it turns, for positions from the centers of the ranges [rad]."""
    pose, poses = np.eye(4), []
    for (origin_m, rpy_rad, axis, lower, upper), angle in zip(chain, position_rad, strict=True):
        poses.append(pose @ transform(origin_m, rpy_rad))
        pose = poses[-1] @ turn(axis, angle + (lower + upper) / 2)
    return poses


@arms
def test_frames_and_axes_are_those_of_the_published_arm_over_random_poses(
    name: str, chain: Chain, to_base: tuple[tuple[float, ...], ...]
) -> None:
    robot = SteppedRobot(ROBOTS / name)
    random = np.random.default_rng(100)
    for _ in range(200):
        position_rad = random.uniform(robot.lower, robot.upper)
        robot.place(position_rad)
        poses = published(chain, position_rad)
        start_m = np.array((*poses[0][:2, 3], 0.0))
        for frame, pose, (_, _, axis, *_) in zip(FRAMES, poses, chain, strict=True):
            joint, turned = robot.data.joint(frame), np.array(to_base) @ pose[:3, :3] @ np.array(axis)
            assert joint.xaxis == pytest.approx(turned, abs=1e-3), frame
            if frame != "shoulder_pan":  # its frame may be anywhere on its axis
                assert joint.xanchor == pytest.approx(np.array(to_base) @ (pose[:3, 3] - start_m), abs=2.5e-4), frame


@arms
def test_ranges_masses_and_torques_are_published(name: str, chain: Chain, to_base: object) -> None:
    del to_base
    robot = SteppedRobot(ROBOTS / name)
    for joint, (*_, lower, upper) in zip(robot.type.joints[:5], chain[:5], strict=True):
        half = (upper - lower) / 2
        assert (joint.lower_rad, joint.upper_rad) == pytest.approx((-half, half), abs=2e-3), joint.name
    assert (robot.type.joints[5].lower_rad, robot.type.joints[5].upper_rad) == chain[5][3:]
    assert [robot.model.body(body).mass[0] for body in BODIES] == pytest.approx(MASS_KG[name])
    assert tuple(joint.max_effort_nm for joint in robot.type.joints) == STALL_NM[name]
    fastest = zip(robot.type.joints, NO_LOAD_RAD_S[name], strict=True)
    assert all(joint.max_velocity_rad_s < limit for joint, limit in fastest), "faster than the servo"
