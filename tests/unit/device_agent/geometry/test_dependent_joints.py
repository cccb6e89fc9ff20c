"""IK and jogs with dependent and mirrored joints."""

import math

import numpy as np
import pytest

from device_agent import geometry
from device_agent.geometry.mujoco_geometry import MujocoGeometry
from device_agent.ports.geometry import GeometryError
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.paths import ROBOTS

STEP_S = 1e-4


def loaded(name: str) -> tuple[RobotType, MujocoGeometry, np.ndarray]:
    kind = robot_type.load(ROBOTS / name)
    shape = geometry.load(kind, ROBOTS / name)
    assert isinstance(shape, MujocoGeometry)
    return kind, shape, np.array([kind.home_rad[joint.name] for joint in kind.joints])


@pytest.fixture(scope="module")
def head() -> tuple[RobotType, MujocoGeometry, np.ndarray]:
    """Moved by rods, except for the neck's rotation."""
    return loaded("hanson")


@pytest.fixture(scope="module")
def walker() -> tuple[RobotType, MujocoGeometry, np.ndarray]:
    """One motor turns a joint of both legs."""
    return loaded("nao")


def test_ik_solves_for_dependent_joints(
    head: tuple[RobotType, MujocoGeometry, np.ndarray],
) -> None:
    kind, shape, home = head
    random = np.random.default_rng(3)
    moved = [index for index, joint in enumerate(kind.joints) if "Gimbal" in joint.name or "Neck" in joint.name]
    for _ in range(4):
        there = home.copy()
        there[moved] += random.uniform(-0.3, 0.3, len(moved))
        wanted = shape.poses(there.tolist())["head"]
        found = shape.poses(shape.solve("head", wanted, home.tolist()))["head"]
        assert found[:3] == pytest.approx(wanted[:3], abs=2e-4)
        assert abs(np.dot(found[3:], wanted[3:])) == pytest.approx(1.0, abs=1e-6)


def test_ik_rejects_poses_that_motors_cannot_reach(
    head: tuple[RobotType, MujocoGeometry, np.ndarray],
) -> None:
    _, shape, home = head
    x, y, z, *turn = shape.poses(home.tolist())["head"]
    with pytest.raises(GeometryError, match="found no joint position for head: the closest one is"):
        shape.solve("head", (x, y, z + 0.05, *turn), home.tolist())  # type: ignore[arg-type]


def test_ik_moves_mirrored_joints_together(
    walker: tuple[RobotType, MujocoGeometry, np.ndarray],
) -> None:
    kind, shape, home = walker
    names = [joint.name for joint in kind.joints]
    there = home.copy()
    for name in ("LHipYawPitch", "RHipYawPitch"):
        there[names.index(name)] -= 0.12
    wanted = shape.poses(there.tolist())["RLeg"]
    found = shape.solve("RLeg", wanted, home.tolist())
    assert found[names.index("RHipYawPitch")] == pytest.approx(found[names.index("LHipYawPitch")], abs=1e-12)
    assert shape.poses(found)["RLeg"][:3] == pytest.approx(wanted[:3], abs=2e-4)


@pytest.mark.parametrize(
    ("robot", "frame", "twist"),
    [
        ("hanson", "head", (0.0, 0.0, 0.0, 0.0, 0.05, 0.0)),  # a nod by rods
        ("nao", "RLeg", (0.02, 0.0, 0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_jogs_use_motor_joints_only(
    robot: str, frame: str, twist: tuple[float, ...], request: pytest.FixtureRequest
) -> None:
    kind, shape, home = request.getfixturevalue({"hanson": "head", "nao": "walker"}[robot])
    rates = np.array(shape.rates(frame, twist, home.tolist(), tool=False))
    names = [joint.name for joint in kind.joints]
    for mirror in kind.mimic_joints:
        assert rates[names.index(mirror.joint)] == mirror.multiplier * rates[names.index(mirror.mimics)]
    before, after = (np.array(shape.poses((home + rates * at).tolist())[frame]) for at in (0.0, STEP_S))
    linear = (after[:3] - before[:3]) / STEP_S
    turned = 2 * math.acos(min(1.0, abs(float(before[3:] @ after[3:])))) / STEP_S
    asked, does = (
        (np.array(twist[:3]), linear) if any(twist[:3]) else (np.array([np.linalg.norm(twist)]), np.array([turned]))
    )
    assert np.linalg.norm(does - asked) < 0.4 * np.linalg.norm(asked), "damped near the limits"
