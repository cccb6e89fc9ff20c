"""The SO-101 against its published measures."""

import mujoco
import numpy as np
import pytest

from tests.harness.paths import ROBOTS
from tests.unit.robots.folders import SteppedRobot

# ``so101_new_calib.urdf``: origin of each joint in its parent's link [m] and [rad], and the frame of the gripper.
ORIGINS = {
    "shoulder_pan": ((0.0207909, -0.0230745, 0.0948817), (-np.pi, 0.0, np.pi / 2)),
    "shoulder_lift": ((-0.0303992, -0.0182778, -0.0542), (-np.pi / 2, -np.pi / 2, 0.0)),
    "elbow_flex": ((-0.11257, -0.028, 0.0), (0.0, 0.0, np.pi / 2)),
    "wrist_flex": ((-0.1349, 0.0052, 0.0), (0.0, 0.0, -np.pi / 2)),
    "wrist_roll": ((0.0, -0.0611, 0.0181), (np.pi / 2, 0.0, np.pi)),
    "grip": ((-0.0079, -0.000218121, -0.0981274), (np.pi / 2, 0.0, np.pi / 2)),
}
LIMITS_RAD = {
    "shoulder_pan": (-1.91986, 1.91986),
    "shoulder_lift": (-1.74533, 1.74533),
    "elbow_flex": (-1.69, 1.69),
    "wrist_flex": (-1.65806, 1.65806),
    "wrist_roll": (-2.79253, 2.79253),
    "gripper": (-0.174533, 1.74533),
}
MASS_KG = {
    "base": 0.147,
    "shoulder": 0.100006,
    "upper_arm": 0.103,
    "lower_arm": 0.104,
    "wrist": 0.079,
    "gripper": 0.087,
    "jaw": 0.012,
}
TOLERANCE_M = 2.5e-4
"""The model leaves out an offset of 0.2 mm in the gripper, and rounds to 0.01 mm."""


def transform(origin_m: tuple[float, ...], rpy_rad: tuple[float, ...]) -> np.ndarray:
    """Pose of an origin of a URDF."""
    quaternion, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_euler2Quat(quaternion, np.array(rpy_rad), "XYZ")
    mujoco.mju_quat2Mat(matrix, quaternion)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = matrix.reshape(3, 3), origin_m
    return pose


def published(position_rad: np.ndarray) -> dict[str, np.ndarray]:
    """Position of each frame, in the axes of the robot type [m]."""
    to_base = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    axis_m = np.array([*ORIGINS["shoulder_pan"][0][:2], 0.0])
    pose, positions = np.eye(4), {}
    for name, angle in zip(ORIGINS, [*position_rad[:5], 0.0], strict=True):
        pose = pose @ transform(*ORIGINS[name]) @ transform((0, 0, 0), (0, 0, angle))
        positions[name] = to_base @ (pose[:3, 3] - axis_m)
    return positions


def test_frames_are_those_of_the_published_arm_over_random_poses():
    robot = SteppedRobot(ROBOTS / "so101")
    random = np.random.default_rng(101)
    for _ in range(200):
        position_rad = random.uniform(robot.lower, robot.upper)
        robot.place(position_rad)
        for name, expected in published(position_rad).items():
            site = "shoulder" if name == "shoulder_pan" else name
            found = robot.data.body(site).xpos if site == "shoulder" else robot.data.site(site).xpos
            assert found == pytest.approx(expected, abs=TOLERANCE_M), name


def test_limits_and_masses_are_published():
    robot = SteppedRobot(ROBOTS / "so101")
    assert {joint.name: (joint.lower_rad, joint.upper_rad) for joint in robot.type.joints} == LIMITS_RAD
    assert {name: robot.model.body(name).mass[0] for name in MASS_KG} == pytest.approx(MASS_KG)
    assert all(joint.max_velocity_rad_s < 5.4 for joint in robot.type.joints), "faster than the servo"
