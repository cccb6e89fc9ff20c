"""IK and jogs with dependent and mirrored joints."""

import math
from functools import cache

import numpy as np
import pytest

from device_agent.geometry.mujoco_geometry import MujocoGeometry
from device_agent.ports.geometry import GeometryError
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.paths import ROBOTS

pytestmark = pytest.mark.slow
STEP_S = 1e-4


@cache
def loaded(name: str) -> tuple[RobotType, MujocoGeometry, list[str], np.ndarray]:
    """Type, geometry, joint names and home position."""
    kind = robot_type.load(ROBOTS / name)
    names = [joint.name for joint in kind.joints]
    return kind, MujocoGeometry(kind, ROBOTS / name / kind.scene), names, np.array([kind.home_rad[n] for n in names])


def test_ik_solves_for_joints_moved_by_rods() -> None:
    _, shape, names, home = loaded("hanson")
    random = np.random.default_rng(3)
    motors = [index for index, name in enumerate(names) if "Gimbal" in name or "Neck" in name]
    for _ in range(4):
        position = home.copy()
        position[motors] += random.uniform(-0.3, 0.3, len(motors))
        target = shape.poses(position.tolist())["head"]
        pose = shape.poses(shape.solve("head", target, home.tolist()))["head"]
        assert pose[:3] == pytest.approx(target[:3], abs=2e-4)
        assert abs(np.dot(pose[3:], target[3:])) == pytest.approx(1.0, abs=1e-6)
    x, y, z, *turn = shape.poses(home.tolist())["head"]
    with pytest.raises(GeometryError, match="found no joint position for head: the closest one is"):
        shape.solve("head", (x, y, z + 0.05, *turn), home.tolist())  # type: ignore[arg-type]


def test_ik_moves_mirrored_joints_together() -> None:
    _, shape, names, home = loaded("nao")
    left, right = names.index("LHipYawPitch"), names.index("RHipYawPitch")
    position = home.copy()
    position[[left, right]] -= 0.12
    target = shape.poses(position.tolist())["RLeg"]
    solution = shape.solve("RLeg", target, home.tolist())
    assert solution[right] == pytest.approx(solution[left], abs=1e-12)
    assert shape.poses(solution)["RLeg"][:3] == pytest.approx(target[:3], abs=2e-4)


@pytest.mark.parametrize(
    ("robot", "frame", "twist"),
    [
        ("hanson", "head", (0.0, 0.0, 0.0, 0.0, 0.05, 0.0)),  # a nod by rods
        ("nao", "RLeg", (0.02, 0.0, 0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_jogs_use_motor_joints_only(robot: str, frame: str, twist: tuple[float, ...]) -> None:
    kind, shape, names, home = loaded(robot)
    rates = np.array(shape.rates(frame, twist, home.tolist(), tool=False))
    for mirror in kind.mimic_joints:
        assert rates[names.index(mirror.joint)] == mirror.multiplier * rates[names.index(mirror.mimics)]
    before, after = (np.array(shape.poses((home + rates * at).tolist())[frame]) for at in (0.0, STEP_S))
    if any(twist[:3]):
        error = np.linalg.norm((after[:3] - before[:3]) / STEP_S - twist[:3])
    else:
        error = abs(2 * math.acos(min(1.0, abs(float(before[3:] @ after[3:])))) / STEP_S - np.linalg.norm(twist))
    assert error < 0.4 * np.linalg.norm(twist), "damped near the limits"
